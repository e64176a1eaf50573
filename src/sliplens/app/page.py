"""Page of one browser: controls made with NiceGUI around a view that draws the messages of the feed."""

import secrets
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING

from nicegui import binding, run, ui
from nicegui.events import KeyEventArguments

from sliplens.app.feed import CHART_S, Client
from sliplens.errors import InputError, SliplensError
from sliplens.explainers.table import EXPLAINERS, RECOMMENDED_METHOD
from sliplens.grip.controllers import CONTROLLERS
from sliplens.grip.source import GripSource
from sliplens.live.reading import NO_NETWORK, TARGET
from sliplens.live.sources import SimulatedSource
from sliplens.plots.saliency import LOWERS, RAISES
from sliplens.plots.style import BLUE, method_name

if TYPE_CHECKING:
    from sliplens.app.server import LivePage

_MOST_PRESS_N, _MOST_PULL_N = 3.0, 2.4
_MOST_WATER_KG, _MOST_GRIP_PULL_N = 0.06, 0.6


class LiveView(ui.element, component="live_view.js"):
    """Number, picture, chart and lamps, which change with each reading."""

    def __init__(self, page: "LivePage", name: str) -> None:
        super().__init__()
        self._props.update({
            "path": f"/frames/{name}",
            "chart-s": CHART_S,
            "target": TARGET,
            "lowers": LOWERS,
            "raises": RAISES,
            "methods": {name: row.title for name, row in EXPLAINERS.items()},
            "recommended": RECOMMENDED_METHOD,
            "grips": isinstance(page.reader.source, GripSource),
        })  # fmt: skip


@binding.bindable_dataclass
class Hand:
    """Forces on the simulated fingertip, which all clients share."""

    press_n: float = 1.5
    pull_n: float = 0.0


class _Actions:
    """Actions of one client, by button or key."""

    def __init__(self, page: "LivePage", client: Client) -> None:
        self._page, self._feed, self._reader, self.client = page, page.feed, page.reader, client
        self.method = RECOMMENDED_METHOD
        """Explainer of a frozen picture."""

    @property
    def freeze_words(self) -> str:
        """Label of the button that freezes."""
        return "Freeze (F)" if self.client.frozen is None else "Go on (F)"

    async def take_reference(self) -> None:
        """Take a new reference as soon as the picture is still."""
        self._feed.take_reference()

    async def new_object(self) -> None:
        """Forget the friction of the object, and show what its slips taught."""
        lesson = self._reader.lesson
        self._reader.new_object()
        ui.notify(lesson or "nothing is known of the friction of the new object", timeout=10_000)

    async def freeze(self) -> None:
        """Stop at the picture, or let it run again."""
        if self.client.frozen is None:
            self.client.freeze()
        else:
            self.client.thaw()

    async def explain(self) -> None:
        """Freeze the picture and explain it."""
        if self._reader.network is None:
            raise InputError(NO_NETWORK)
        client, method = self.client, self.method
        picture = client.freeze()
        if picture is None or client.waiting:
            return
        client.waiting = f"explaining frame {picture.frame.number} by {method_name(method)}"
        client.wake()
        try:
            explained = await self._feed.explain(picture, method)
            if client.frozen is picture:
                client.explained = explained
        finally:
            client.waiting = ""
            client.wake()

    async def record(self) -> None:
        """Record, or end the recording."""
        if self._reader.recorder is None:
            await run.io_bound(self._reader.record, self._page.record_into, facts=self._page.facts)
            return
        data = await run.io_bound(self._reader.stop_recording)
        if data is None:
            ui.notify("nothing was recorded: no frame came", type="warning")
        else:
            ui.notify(f"recorded into {data.folder}; look with `sliplens check {data.folder}`", type="positive")


def _with_notice(act: Callable[[], Awaitable[None]]) -> Callable[[], Awaitable[None]]:
    """Show the client why an action failed."""

    async def acted() -> None:
        try:
            await act()
        except (SliplensError, OSError) as error:
            ui.notify(str(error), type="warning", multi_line=True, timeout=10_000)

    return acted


def build_live(page: "LivePage") -> None:
    """Build the page of one client."""
    feed, reader = page.feed, page.reader
    client, name = Client(feed), secrets.token_urlsafe(9)
    feed.expected[name] = client
    ui.context.client.on_delete(lambda: feed.expected.pop(name, None))
    acts = _Actions(page, client)
    style = Path(__file__).with_name("live_view.css").read_text(encoding="utf-8")
    ui.add_head_html(f"<style>{style}</style>")  # add_css needs a script
    ui.colors(primary=BLUE)
    ui.query(".nicegui-content").classes("sl-page")
    with LiveView(page, name):
        if isinstance(reader.source, SimulatedSource):
            _build_hand(page.hand, reader.source)
        elif isinstance(reader.source, GripSource):
            _build_gripper(reader.source)
        with ui.element("div").classes("sl-buttons"):
            ui.button("Reference (R)", on_click=_with_notice(acts.take_reference)).tooltip(
                "take a new image of the untouched sensor, as soon as the picture is still"
            )
            ui.button("New object (N)", on_click=_with_notice(acts.new_object)).tooltip(
                "another one is held from now on, or this one was wetted: what is known of its friction is dropped"
            )
            ui.button(on_click=_with_notice(acts.freeze)).bind_text_from(acts, "freeze_words").tooltip(
                "keep this picture; the margin runs on"
            )
            ui.button(on_click=_with_notice(acts.record)).bind_text_from(
                reader, "recorder", lambda recorder: "Record (C)" if recorder is None else "Stop recording (C)"
            ).tooltip(f"every frame into {page.record_into}")
        _build_overlays(acts, network=reader.network is not None)
    by_key = {
        "r": acts.take_reference, "n": acts.new_object, "f": acts.freeze, "e": acts.explain, "c": acts.record
    }  # fmt: skip

    async def press_key(event: KeyEventArguments) -> None:
        modifiers = event.modifiers
        is_plain = not (modifiers.ctrl or modifiers.alt or modifiers.meta)
        act = by_key.get(str(event.key.name).lower())
        if act is not None and event.action.keydown and not event.action.repeat and is_plain:
            await _with_notice(act)()

    ui.keyboard(on_key=press_key, repeating=False, ignore=["input", "select", "textarea"])


def _build_overlays(acts: _Actions, *, network: bool) -> None:
    """Build the switches of map and markers, and the explainer."""

    def show() -> None:
        acts.client.shows_map, acts.client.shows_arrows = bool(map_switch.value), bool(arrow_switch.value)
        acts.client.wake()

    with ui.element("div").classes("sl-buttons"):
        map_switch = ui.switch("Map", value=network, on_change=show)
        map_switch.set_enabled(network)
        arrow_switch = ui.switch("Markers", value=True, on_change=show)
        if network:
            names = {method: row.title for method, row in EXPLAINERS.items()}
            ui.select(names, label="explain by").props("dense outlined options-dense").bind_value(acts, "method")
            ui.button("Explain (E)", on_click=_with_notice(acts.explain)).tooltip(
                "why, of this picture, by the method beside"
            )


def _add_slider(
    label: str, shared: object, name: str, *, words: Callable[[float], str], most: float, act: Callable[[float], None]
) -> None:
    """Add a slider of an attribute that all clients share, beside its value in words."""
    ui.label().bind_text_from(shared, name, words)
    slider = ui.slider(min=0, max=most, step=most / 60).props(f'aria-label="{label}"').bind_value_from(shared, name)
    slider.on("update:model-value", lambda event: act(float(event.args)), throttle=0.05)


def _build_hand(hand: Hand, source: SimulatedSource) -> None:
    """Build the sliders that press and pull the fingertip."""

    def load(**forces_n: float) -> None:
        for name, force_n in forces_n.items():
            setattr(hand, name, force_n)
        source.load(normal_force_n=hand.press_n, tangential_force_n=hand.pull_n)

    with ui.element("div").classes("sl-hand"):
        for word, name, most_n in (("Press", "press_n", _MOST_PRESS_N), ("Pull", "pull_n", _MOST_PULL_N)):
            _add_slider(
                f"{word} the fingertip, in newtons",
                hand,
                name,
                words=lambda force_n, word=word: f"{word} {force_n:.2f} N",
                most=most_n,
                act=lambda force_n, name=name: load(**{name: force_n}),
            )
        ui.button("Grip by itself", on_click=source.let_go).tooltip(
            "touch, press, pull until it slips, let go, and again"
        )


def _build_gripper(source: GripSource) -> None:
    """Build the controls of a simulated gripper and its object, which all clients share."""
    with ui.element("div").classes("sl-hand"):
        _add_slider(
            "Pour water in, in kilograms",
            source,
            "water_kg",
            words=lambda water_kg: f"Water {1e3 * water_kg:.0f} g",
            most=_MOST_WATER_KG,
            act=lambda water_kg: source.act(water_kg=water_kg),
        )
        _add_slider(
            "Pull at it, in newtons",
            source,
            "pull_n",
            words=lambda pull_n: f"Pull {pull_n:.2f} N",
            most=_MOST_GRIP_PULL_N,
            act=lambda pull_n: source.act(pull_n=pull_n),
        )
    with ui.element("div").classes("sl-buttons"):
        ui.switch("Wet", on_change=lambda event: source.act(wet=bool(event.value))).bind_value_from(source, "wet")
        ui.select(
            list(CONTROLLERS), label="held by", on_change=lambda event: source.act(controller=str(event.value))
        ).props("dense outlined options-dense").bind_value_from(source, "controller")
        ui.button("Grip again", on_click=source.grip_again).tooltip("put it down, open, grip and lift it anew")
