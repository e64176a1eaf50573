"""Tables of how far explanations can be believed: the thesis's score beside the sound ones, at equal areas, by fill."""

from sliplens.report.records import MethodScore, Scored
from sliplens.report.study.evidence import mean_at, settings, tell_bounds
from sliplens.report.study.scored import Faithful, Remedies, SoundScore, VariantScore
from sliplens.report.style import (
    CONTROLS,
    FILL_NAMES,
    UNIT_NAMES,
    UNKNOWN,
    decimals,
    fill_name,
    in_order,
    input_name,
    method_name,
    methods_in_order,
    percent,
    signed,
)
from sliplens.report.tables import Cell, Kind, Shade, Table, table_head, tell_spread
from sliplens.report.thesis import DELETION, MARK, thesis_row

_AREAS = (0.01, 0.02, 0.05, 0.1, 0.2)


def table_scores(faithful: Faithful, scored: Scored | None) -> Table:
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


def table_equal_areas(faithful: Faithful) -> Table | None:
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


def table_agreement(faithful: Faithful) -> Table | None:
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


def table_remedies(remedies: Remedies, scored: Scored | None) -> Table:
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


def _highest(scores: list[SoundScore]) -> float | None:
    return max((score.srg.estimate for score in scores if not score.control), default=None)


def _gain_cell(score: SoundScore | None, best: float | None) -> Cell:
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


def _score_cell(score: MethodScore | VariantScore | None, best: float | None) -> Cell:
    if score is None:
        return Cell(text=UNKNOWN)
    return Cell(text=tell_spread(score.mean, score.sd), kind="best" if score.mean == best else "number")
