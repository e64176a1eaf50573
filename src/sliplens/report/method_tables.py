"""Tables of what else is known of the methods: looks, weights drawn anew, cost, choice of trials, and the truth."""

from sliplens.plots.style import (
    CONTROL,
    CONTROLS,
    FILL_NAMES,
    UNIT_NAMES,
    UNKNOWN,
    decimals,
    fill_name,
    in_order,
    input_name,
    inputs_in_order,
    method_name,
    methods_in_order,
    percent,
    short_input_name,
    signed,
)
from sliplens.report.believing import mean_at, settings, tell_bounds, tell_interval
from sliplens.report.tables import Cell, Kind, Shade, Table, table_head, tell_spread
from sliplens.report.thesis import DELETION, MARK, NETWORK_PIXELS, SECONDS, thesis_row
from sliplens.results.faithfulness import DeletionScores, MethodScore, Remedies, RemovalScore, RemovalScores
from sliplens.results.study import MAP_MEASURES, REGIONS, Choice, Localisation, MapQuality, Randomisation, Timing, Truth

_AREAS = (0.01, 0.02, 0.05, 0.1, 0.2)


def table_scores(faithful: RemovalScores, scored: DeletionScores | None) -> Table:
    """Tabulate the thesis's deletion score (its Table 2) beside the symmetric gain under every fill."""
    columns = settings(faithful)
    scores = {score.key: score for score in faithful.scores}
    known = {score.method: score.control for score in faithful.scores}
    best = {one: _highest([score for key, score in scores.items() if key[:2] == one]) for one in columns}
    plain = {} if scored is None else scored.methods
    lowest = min((one.mean for name, one in plain.items() if name not in CONTROLS), default=None)
    rows = []
    for method in methods_in_order({*known, *plain}):
        own = plain.get(method)
        row = thesis_row(method, {*known, *plain})
        thesis = DELETION.get((faithful.input, row)) if row else None
        kind: Kind = "best" if own is not None and own.mean == lowest else "number"
        rows.append(
            (
                Cell(text=method_name(method), kind="name"),
                Cell(text=UNKNOWN if own is None else tell_spread(own.mean, own.sd), kind=kind),
                Cell(text=tell_spread(*thesis) if thesis else UNKNOWN, kind="thesis"),
                *(_gain_cell(scores.get((*one, method)), best[one]) for one in columns),
            )
        )
    fill = f", {scored.fill} fill" if scored else ""
    return Table(
        caption=f"{input_name(faithful.input)}: the deletion score D of the thesis{fill} (mean ± standard deviation "
        "over frames; lower = more faithful) beside the symmetric relevance gain, SRG: the mean change of the answer "
        "with the most supporting parts gone first, less that with the least supporting first, in margin units; 0 = "
        f"a map that tells nothing. 95 % intervals over {faithful.trials} trials ({faithful.frames} frames); * = the "
        f"interval leaves zero out. Bold: best of its column, controls left out. Grey column: the {MARK}.",
        head=table_head(
            "Method", "Score D", "Score D, thesis", *(f"SRG, {fill_name(fill, unit)}" for fill, unit in columns)
        ),
        rows=tuple(rows),
    )


def table_equal_areas(faithful: RemovalScores) -> Table | None:
    """Tabulate the change where equal areas are gone, under the most natural fill; None without scores."""
    found = settings(faithful)
    if not found:
        return None
    fill, unit = found[0]
    scores = {score.method: score for score in faithful.scores if score.key[:2] == (fill, unit)}
    areas = [area for area in _AREAS if any(area in score.at for score in scores.values())]
    rows = []
    for method in methods_in_order(scores):
        cells = []
        for area in areas:
            tops = [score.at[area] for score in scores.values() if area in score.at and not score.control]
            value = scores[method].at.get(area)
            best = value is not None and not scores[method].control and value == max(tops)
            cells.append(Cell(text=decimals(value, 3), kind="best" if best else "number"))
        rows.append((Cell(text=method_name(method), kind="name"), *cells))
    curve = next(iter(curve for key, curve in faithful.curves.items() if key[:2] == (fill, unit)))
    chance = (Cell(text=f"{faithful.random_orders} random orders", kind="name"),)
    chance += tuple(Cell(text=decimals(mean_at(curve, area)[1], 3)) for area in areas)
    return Table(
        caption=f"{input_name(faithful.input)}: mean evidence lost, in margin units, where equal shares of the "
        f"image are gone, most supporting {UNIT_NAMES.get(unit, unit)} first (fill: {fill_name(fill)}). Bold: largest "
        "of the methods.",
        head=table_head("Method", *(f"{percent(area)} gone" for area in areas)),
        rows=(*rows, chance),
    )


def table_agreement(faithful: RemovalScores) -> Table | None:
    """Tabulate Kendall's tau between the fills' rankings of the methods as a map of heat; None where it is unknown."""
    rows = [one for one in faithful.agreement if one.unit == "pixel"] or list(faithful.agreement)
    if not rows:
        return None
    taus = {(one.first, one.second): one.tau for one in rows}
    taus |= {(one.second, one.first): one.tau for one in rows}
    fills = in_order({name for pair in taus for name in pair}, FILL_NAMES)
    unit = UNIT_NAMES.get(rows[0].unit, rows[0].unit)
    known = [one.tau for one in rows if one.tau is not None]
    worst = f" The lowest is {signed(min(known), 2)}." if known else ""
    return Table(
        caption=f"{input_name(faithful.input)}: how far two fills agree on the order of the methods ({unit}): "
        f"Kendall's tau, 1 for the same order, 0 for unrelated ones; darker = closer.{worst}",
        head=table_head("Fill", *(fill_name(fill) for fill in fills)),
        rows=tuple(
            (
                Cell(text=fill_name(fill), kind="name"),
                *(_tau_cell(taus.get((fill, other)), same=fill == other) for other in fills),
            )
            for fill in fills
        ),
    )


def table_remedies(remedies: Remedies, scored: DeletionScores | None) -> Table:
    """Tabulate the thesis's own remedies for its score, and insertion, beside the score as it was."""
    methods = methods_in_order({name for one in remedies.variants.values() for name in one.methods})
    rows = []
    if scored is not None:
        plain = {name: one.mean for name, one in scored.methods.items() if name in methods and name not in CONTROLS}
        lowest = min(plain.values(), default=None)
        cells = [_score_cell(scored.methods.get(name), lowest) for name in methods]
        rows.append(
            (Cell(text=f"As in the thesis ({scored.fill})", kind="name"), Cell(text="lower", kind="name"), *cells)
        )
    for name, variant in remedies.variants.items():
        means = [one.mean for method, one in variant.methods.items() if method not in CONTROLS]
        best = (min if variant.better == "lower" else max)(means, default=None)
        cells = [_score_cell(variant.methods.get(method), best) for method in methods]
        rows.append(
            (
                Cell(text=name.replace("-", " ").capitalize(), kind="name"),
                Cell(text=variant.better, kind="name"),
                *cells,
            )
        )
    told = " ".join(
        f"{name.replace('-', ' ').capitalize()}: {one.told.rstrip('.')}." for name, one in remedies.variants.items()
    )
    return Table(
        caption=f"{input_name(remedies.input)}: the score of the thesis with the remedies it proposes, and insertion; "
        f"mean ± standard deviation over frames, the best method of each row bold. {told}",
        head=table_head("Variant", "Better is", *(method_name(name) for name in methods)),
        rows=tuple(rows),
    )


def _highest(scores: list[RemovalScore]) -> float | None:
    return max((score.srg.estimate for score in scores if not score.control), default=None)


def _gain_cell(score: RemovalScore | None, best: float | None) -> Cell:
    if score is None:
        return Cell(text=UNKNOWN)
    kind: Kind = "best" if not score.control and score.srg.estimate == best else "number"
    mark = "*" if score.srg.sure else ""
    # in two lines, so that every fill fits beside the others
    return Cell(text=f"{signed(score.srg.estimate, 3)}{mark}\n{tell_bounds(score.srg)}", kind=kind)


def _tau_cell(tau: float | None, *, same: bool) -> Cell:
    if same:
        return Cell(text="·")
    return Cell(text=UNKNOWN if tau is None else signed(tau, 2), shade=_shade(tau))


def _shade(tau: float | None) -> Shade:
    shades: tuple[Shade, ...] = (0, 1, 2, 3, 4)
    steps = (-1.0, 0.0, 0.4, 0.8)
    return shades[0] if tau is None else shades[sum(tau >= step for step in steps)]


def _score_cell(score: MethodScore | MethodScore | None, best: float | None) -> Cell:
    if score is None:
        return Cell(text=UNKNOWN)
    return Cell(text=tell_spread(score.mean, score.sd), kind="best" if score.mean == best else "number")


_LOOK_NAMES = {
    "resolution": "Resolution",
    "total_variation": "Total variation",
    "gini": "Sparsity (Gini)",
    "noise_stability": "Stable under noise",
    "frame_stability": "Stable between frames",
}
_REGION_NAMES = {"markers": "markers", "slip_annulus": "slip annulus", "edges": "marker edges"}
_TRUTHS = ("oracle", "degraded-oracle")


def table_looks(looks: dict[str, MapQuality]) -> Table:
    """Tabulate what the eye judges of maps."""
    names = inputs_in_order(looks)
    rows = [
        (
            Cell(text=input_name(name), kind="name"),
            Cell(text=method_name(method), kind="name"),
            *(Cell(text=decimals(looks[name].methods[method][measure], 3)) for measure in MAP_MEASURES),
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
        head=table_head("Input", "Method", *(_LOOK_NAMES[measure] for measure in MAP_MEASURES)),
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
