"""Tables of what else is known of the methods: looks, weights drawn anew, cost, choice of trials, and the truth."""

from sliplens.report.study.evidence import tell_interval
from sliplens.report.study.localised import REGIONS, Localisation, Truth
from sliplens.report.study.records import LOOKS, Choice, Looks, Randomisation, Timing
from sliplens.report.style import (
    CONTROL,
    FILL_NAMES,
    UNKNOWN,
    decimals,
    input_name,
    inputs_in_order,
    method_name,
    methods_in_order,
    percent,
    short_input_name,
)
from sliplens.report.tables import Cell, Table, table_head
from sliplens.report.thesis import NETWORK_PIXELS, SECONDS, thesis_row

_LOOK_NAMES = {
    "resolution": "Resolution",
    "total_variation": "Total variation",
    "gini": "Sparsity (Gini)",
    "noise_stability": "Stable under noise",
    "frame_stability": "Stable between frames",
}
_REGION_NAMES = {"markers": "markers", "slip_annulus": "slip annulus", "edges": "marker edges"}
_TRUTHS = ("oracle", "degraded-oracle")


def table_looks(looks: dict[str, Looks]) -> Table:
    """Tabulate what the eye judges of maps."""
    names = inputs_in_order(looks)
    rows = [
        (
            Cell(text=input_name(name), kind="name"),
            Cell(text=method_name(method), kind="name"),
            *(Cell(text=decimals(looks[name].methods[method][measure], 3)) for measure in LOOKS),
        )
        for name in names
        for method in methods_in_order(looks[name].methods)
    ]
    frames = max(one.frames for one in looks.values())
    return Table(
        caption=f"Looks of the maps, means over {frames} frames. Resolution: depth of the valley between neighbouring "
        "markers (1 = told apart). Total variation: mean step between pixels over the map's range (noise has 1/3). "
        "Gini: 1 = one pixel has all. Stability: correlation of the map with that of the frame under other sensor "
        "noise, and with that of the next frame.",
        head=table_head("Input", "Method", *(_LOOK_NAMES[measure] for measure in LOOKS)),
        rows=tuple(rows),
    )


def table_randomisation(randomisation: dict[str, Randomisation]) -> Table:
    """Tabulate what is left of a map once every layer has new weights, and how its complexity rises."""
    rows = []
    for name in inputs_in_order(randomisation):
        methods = randomisation[name].methods
        for method in methods_in_order(methods):
            one = methods[method]
            similar = one.similarity
            rows.append(
                (
                    Cell(text=input_name(name), kind="name"),
                    Cell(text=method_name(method), kind="name"),
                    Cell(text=decimals(similar[0] if similar else None, 2)),
                    Cell(text=decimals(similar[-1] if similar else None, 2)),
                    Cell(text=decimals(one.complexity_rise, 2)),
                    Cell(text=decimals(one.smooth_complexity_rise, 2)),
                )
            )
    counts = {one.layers[0] for found in randomisation.values() for one in found.methods.values() if one.layers}
    first = f"{counts.pop()} layers new" if len(counts) == 1 else "First layers new"
    return Table(
        caption="Weights drawn anew, layer by layer from the output: similarity of the map to the trained network's "
        "(1 = unchanged: such a map does not depend on what was learned), and the rise of its complexity once all are "
        "new (eMPRT), also after smoothing (sMPRT); more is better.",
        head=table_head("Input", "Method", first, "All layers new", "eMPRT", "sMPRT"),
        rows=tuple(rows),
    )


def table_times(timing: dict[str, Timing]) -> Table:
    """Tabulate seconds a frame, with the forward pass and without it, beside those of the thesis."""
    names = inputs_in_order(timing)
    heads = []
    for name in names:
        heads += [f"{short_input_name(name)}, with forward pass", f"{short_input_name(name)}, without"]
    rows, methods = [], {one for name in names for one in timing[name].methods}
    for method in methods_in_order(methods):
        cells = []
        for name in names:
            one = timing[name].methods.get(method)
            spread = "" if one is None or one.low is None else f" ({_seconds(one.low)} to {_seconds(one.high)})"
            cells.append(Cell(text=UNKNOWN if one is None else f"{_seconds(one.seconds)}{spread}"))
            cells.append(Cell(text=_seconds(None if one is None else one.seconds_without_forward)))
        thesis = Cell(text=decimals(SECONDS.get(thesis_row(method, methods) or ""), 3), kind="thesis")
        rows.append((Cell(text=method_name(method), kind="name"), *cells, thesis))
    told = "; ".join(
        f"{input_name(name).lower()}: {one.device}"
        f"{f' with {one.threads} threads' if one.threads and one.device == 'cpu' else ''}, "
        f"{one.repeats} repeats or more, a forward pass takes {_seconds(one.forward_seconds)} s"
        for name in names
        for one in [timing[name]]
    )
    return Table(
        caption=f"Seconds to explain one frame: median of the repeats after a warm-up, and their range ({told}). The "
        f"thesis timed images of {NETWORK_PIXELS} px on an RTX 3060 Ti without waiting for the GPU, and left "
        "Grad-CAM's forward pass out.",
        head=table_head("Method", *heads, "Thesis"),
        rows=tuple(rows),
    )


def table_trials(choice: Choice) -> Table:
    """Tabulate the trials of the study, and how far each network was off at worst."""
    names = inputs_in_order({*choice.inputs, *(name for one in choice.trials for name in one.worst_error)})
    rows = [
        (
            Cell(text=one.trial, kind="name"),
            Cell(text="yes" if one.qualified else "no", kind="name"),
            *(Cell(text=percent(one.worst_error.get(name), digits=1)) for name in names),
            Cell(text=str(sum(frame.trial == one.trial and frame.scored for frame in choice.frames))),
        )
        for one in choice.trials
    ]
    return Table(
        caption=f"The {len(rows)} trials of the study ({choice.condition}): the worst error of each network at the "
        f"chosen margins, in percentage points; within {percent(choice.tolerance)} at all of them it qualifies.",
        head=table_head(
            "Trial", "Qualified", *(f"Worst error, {short_input_name(name).lower()}" for name in names), "Frames scored"
        ),
        rows=tuple(rows),
    )


def table_localisation(truth: Truth) -> Table:
    """Tabulate where relevance lies, and how well maps rank the markers."""
    names = [*methods_in_order(set(truth.methods) - set(_TRUTHS)), *(one for one in _TRUTHS if one in truth.methods)]
    rows = [
        (
            # here it is a map, not an order
            Cell(text="Random map (control)" if name == CONTROL else method_name(name), kind="name"),
            *(Cell(text=percent(truth.methods[name].mass[region])) for region in REGIONS),
            *(Cell(text=percent(truth.methods[name].rank[region])) for region in REGIONS),
            Cell(text=_spearman(truth.methods[name], network=True)),
            Cell(text=_spearman(truth.methods[name], network=False)),
        )
        for name in names
    ]
    nothing = (Cell(text="A map that knows nothing", kind="name"),)
    nothing += tuple(Cell(text=percent(truth.areas[region])) for region in REGIONS) * 2
    nothing += (Cell(text="0"), Cell(text="0"))
    return Table(
        caption=f"{input_name(truth.input)}, {truth.frames} simulated frames: share of the relevance, and of the "
        "strongest pixels, in three regions; and Spearman's correlation of the map's mean on each marker with what "
        "putting that marker back does to the network's answer and to the best reading of the margin (95 % interval "
        "over trials).",
        head=table_head(
            "Method",
            *(f"Mass, {_REGION_NAMES[region]}" for region in REGIONS),
            *(f"Strongest, {_REGION_NAMES[region]}" for region in REGIONS),
            "With the answer",
            "With the best reading",
        ),
        rows=(*rows, nothing),
    )


def table_meta(truth: Truth) -> Table | None:
    """Tabulate whether the score itself ranks a perfect map above a damaged one above chance; None if not tested."""
    if not truth.meta:
        return None
    return Table(
        caption=f"{input_name(truth.input)}: the score put to the test. A map made from the truth must gain more than "
        "that map damaged, and that more than chance; a fill where this fails cannot judge methods, and the verdict "
        "leaves it out.",
        head=table_head("Fill", "Holds", "SRG of the truth", "SRG, damaged", "SRG, random"),
        rows=tuple(
            (
                Cell(text=FILL_NAMES.get(one.fill, one.fill), kind="name"),
                Cell(text="yes" if one.holds else "no", kind="name"),
                *(Cell(text=decimals(value, 3)) for value in (one.oracle, one.degraded, one.random)),
            )
            for one in truth.meta
        ),
    )


def _spearman(found: Localisation, *, network: bool) -> str:
    gap, value = (found.network, found.spearman_network) if network else (found.margin, found.spearman_margin)
    return decimals(value, 2) if gap is None else tell_interval(gap, digits=2)


def _seconds(value: float | None) -> str:
    return decimals(value, 4 if value is not None and value < 0.1 else 2)
