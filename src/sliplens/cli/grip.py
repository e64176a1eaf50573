"""`sliplens grip`."""

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from sliplens.cli.command import Command, InOrder, Output, SameObject
from sliplens.cli.console import print_table
from sliplens.errors import InputError
from sliplens.files import DEFAULT_NETWORK


@dataclass(frozen=True, kw_only=True)
class Grip(Command):
    """Grip, lift and hold a simulated object with the safety margin in the loop.

    One episode is closed through pixels: both fingertips are drawn and predicted by the network, which sets the force.
    It is written as a data set with both fingertips, a clip, and a page with force, margin, slip and map. For more
    episodes, predictions are looked up in the network's measured errors, dozens a second. An interrupted run goes on.
    """

    output: Output
    """Folder to make; the page is report.html in it."""
    object: Literal["cup", "egg", "berries"] = "cup"
    """Object to grip."""
    controller: str = "margin"
    """fixed, assumed-friction, margin, proportional, reflex or oracle, or one of an installed package."""
    condition: str = "dry"
    """Events: dry, wet, drifting, unknown, patch (a wet patch at 2.5 s), jolt, poured or lamp (one goes out)."""
    episodes: int = 1
    """Number of episodes."""
    rendered: bool | None = None
    """Close the loop through pixels; if not given, for a single episode."""
    network: str = DEFAULT_NETWORK
    """Folder of a trained network, or the name of one that comes with sliplens."""
    set: tuple[str, ...] = ()
    """Constants of the controller to change, such as --set target=0.3 down_n_s=2."""
    mass: float | None = None
    """Mass of the object in kilograms; drawn if not given."""
    friction: float | None = None
    """Coefficient of friction at the beginning; drawn if not given."""
    told_friction: Annotated[str | None, tyro.conf.arg(metavar="MU|LOW..HIGH|MU+-SD|each")] = None
    """Friction that predictions of F_t / F_n use: 0.62, 0.3..0.9, or each for that of each episode."""
    grasps: int = 1
    """Number of grasps of each object, one after another."""
    same_object: SameObject = False
    sequence: InOrder = False
    pull: float | None = None
    """Pull on the object in newtons, for 1.5 s; drawn if not given."""
    wet_patch: float | None = None
    """Friction from 2.5 s on over that before, such as 0.5; none if not given."""
    water: float | None = None
    """Water poured in from 2.5 s on, in kilograms; none if not given."""
    latency: float = 0.02
    """Time from an image to the command that answers it, in seconds."""
    method: str | None = "integrated-gradients"
    """Explainer of the page's maps; none for no maps."""
    seed: int = 0
    """Seed: the same seed gives every controller the same episodes."""

    def run(self) -> None:
        """Run the episodes, and draw the page."""
        from sliplens.cli.report import Report
        from sliplens.grip.episodes import EpisodeOptions, run_episodes

        rendered = self.episodes == 1 if self.rendered is None else self.rendered
        script = {
            "mass_kg": self.mass,
            "friction": self.friction,
            "pull_n": self.pull,
            "patch_factor": self.wet_patch,
            "patch_at_s": None if self.wet_patch is None else 2.5,
            "water_kg": self.water,
            "water_at_s": None if self.water is None else 2.5,
        }
        grip = self.call(
            run_episodes,
            options=EpisodeOptions(
                rendered=rendered,
                friction=self.told_friction,
                grasps=self.grasps,
                same_object=self.same_object,
                sequence=self.sequence,
                latency_s=self.latency,
                method=self.method if rendered and self.method != "none" else None,
            ),
            script={name: value for name, value in script.items() if value is not None},
            settings=dict(map(constant, self.set)),
            out=self.output / "grip",
        )
        table = grip.episodes
        rows = [
            ("dropped", f"{int(table.dropped.sum())} of {len(table)}"),
            ("crushed", f"{int(table.crushed.sum())}"),
            ("slip, in the middle", f"{1e3 * float(sorted(table.slip_m)[len(table) // 2]):.1f} mm"),
            ("mean force", f"{table.mean_force_n.mean():.2f} N"),
            ("over the least that holds", f"{100 * table.force_excess.mean():.0f} %"),
            ("time with a margin under 20 %", f"{table.under_20_s.mean():.2f} s"),
        ]
        print_table(f"{self.controller} on a {self.object}, {self.condition}", ("", ""), rows)
        if self.grasps > 1:
            rows = [
                (
                    f"{grasp}",
                    f"{int(part.dropped.sum())} of {len(part)}",
                    f"{100 * part.force_excess.mean():.0f} %",
                    f"{int((part.known_friction > 0).sum())} of {len(part)}",
                )
                for grasp in range(1, self.grasps + 1)
                for part in [table.where(table.grasp == grasp)]
            ]
            columns = ("grasp", "dropped", "over the least that holds", "friction known")
            print_table("Grasp after grasp", columns, rows)
        Report(workspace=self.output).run()


def constant(text: str) -> tuple[str, float]:
    """Parse the name and value of a constant."""
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise InputError(f"{text!r} sets no constant; write --set NAME=NUMBER, such as --set target=0.3") from None
