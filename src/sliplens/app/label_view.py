"""What a browser shows of a trial whose labels are repaired, made with NiceGUI around a view that draws it."""

from pathlib import Path
from typing import TYPE_CHECKING

from nicegui import run, ui
from nicegui.events import GenericEventArguments

from sliplens.codec import to_builtins
from sliplens.errors import SliplensError
from sliplens.plots.style import BLUE

if TYPE_CHECKING:
    from sliplens.app.labels import LabelPage, TrialView


class LabelView(ui.element, component="label_view.js"):
    """Frame, curves and buttons of one trial; tells which trial is wanted, and what is to be edited."""

    def show(self, view: "TrialView", counts: dict[str, int]) -> None:
        """Show a trial, and how many edits each has."""
        self._props.update({"view": to_builtins(view), "counts": counts})
        self.update()


def build_labels(page: "LabelPage") -> None:
    """Page of one viewer."""
    folder = Path(__file__).parent
    for name in ("live_view.css", "label_view.css"):
        ui.add_head_html(f"<style>{(folder / name).read_text(encoding='utf-8')}</style>")  # add_css needs a script
    ui.colors(primary=BLUE)
    ui.query(".nicegui-content").classes("sl-page")
    element = LabelView()

    async def open_trial(trial: str) -> None:
        try:
            view = await run.io_bound(page.look, trial)
            if view is not None:  # None while the server ends
                element.show(view, page.edit_counts)
        except (SliplensError, OSError) as error:
            _tell(error)

    async def edit(event: GenericEventArguments) -> None:
        wish = event.args
        try:
            await run.io_bound(page.edit, wish["trial"], wish["kind"], wish["value"])
        except (SliplensError, OSError) as error:
            _tell(error)
        await open_trial(wish["trial"])

    element.on("edit", edit)
    element.on("open", lambda event: open_trial(event.args))
    ui.timer(0, lambda: open_trial(page.data.trials[0].trial), once=True)


def _tell(error: Exception) -> None:
    ui.notify(str(error), type="warning", multi_line=True, timeout=10_000)
