"""Rules deal whole trials, and whole groups of them, as their file says."""

import hashlib
import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from data_sets import contents
from hypothesis import given
from hypothesis import strategies as st

from sliplens.errors import InputError
from sliplens.recordings import Dataset, TrialFacts, load_dataset
from sliplens.recordings.check import check_dataset
from sliplens.recordings.dataset import DATASET_FILE
from sliplens.recordings.splits import (
    PRESETS,
    SPLITS_FILE,
    SplitPlan,
    SplitRule,
    assign_splits,
    read_splits,
    split_dataset,
)
from sliplens.simulation import PRESETS as RECIPES
from sliplens.simulation import SimulationRecipe, plan_trials


def fact(trial: str, *, day: int = 1, object: str = "", condition: str = "dry", sensor: str = "tip") -> TrialFacts:
    return TrialFacts(trial=trial, day=day, object=object, condition=condition, sensor=sensor)


def written(folder: Path, text: str) -> SplitPlan:
    path = folder / "rules.toml"
    path.write_text(text, encoding="utf-8")
    return read_splits(path)


def dealt(plan: SplitPlan, trials: list[TrialFacts]) -> dict[str, str]:
    return dict(zip((one.trial for one in trials), assign_splits(plan, trials).splits, strict=True))


def shares(by: str, share: dict[str, float], *, seed: int = 0) -> SplitPlan:
    return SplitPlan(rules=(SplitRule(share=share, by=by, seed=seed),))


def groups_of_one(count: int) -> list[TrialFacts]:
    return [fact(f"t{index}") for index in range(count)]


# a data set as a lab has it: objects of several trials, days, both conditions
TABLE = [
    fact("cup-1", object="cup", day=1),
    fact("cup-2", object="cup", day=2, condition="wet"),
    fact("walnut-1", object="walnut", day=2),
    fact("wallet-1", object="wallet", day=3, condition="wet"),
    fact("egg-1", object="egg", day=3),
    fact("egg-2", object="egg", day=4),
]


def test_the_first_rule_that_fits_decides(tmp_path: Path):
    plan = written(
        tmp_path,
        """
        [[split]]
        name = "test"
        day = 4
        [[split]]
        name = "validation"
        object = ["cup", "wal*"]
        condition = "dry"
        [[split]]
        name = "train"
        """,
    )
    # by hand: egg-2 is of day 4; cup-1 and walnut-1 are dry; cup-2 and wallet-1 are wet, egg-1 is another object
    assert assign_splits(plan, TABLE).splits == ("validation", "train", "validation", "train", "train", "test")


@pytest.mark.parametrize(
    ("asked", "fitting"),
    [
        ({"trial": ("cup-?",)}, {"cup-1", "cup-2"}),
        ({"object": ("Cup",)}, set()),
        ({"object": ("wal[ln]*",)}, {"walnut-1", "wallet-1"}),
        ({"day": (1, 3)}, {"cup-1", "wallet-1", "egg-1"}),
        ({"day": (2, 3), "condition": ("wet",)}, {"cup-2", "wallet-1"}),
        ({"sensor": ("tip",), "object": ("egg", "cup")}, {"cup-1", "cup-2", "egg-1", "egg-2"}),
        ({"object": ("",)}, set()),
        ({}, {one.trial for one in TABLE}),
    ],
)
def test_all_that_a_rule_asks_for_must_be_so(asked: dict[str, Any], fitting: set[str]):
    rule = SplitRule(**asked, name="test")
    assert {one.trial for one in TABLE if rule.fits(one)} == fitting


def test_a_name_with_brackets_fits_itself():
    assert SplitRule(trial=("cup[1]",), name="test").fits(fact("cup[1]"))


def test_trials_that_no_rule_fits_are_named():
    plan = SplitPlan(rules=(SplitRule(day=(1, 2), name="train"),), source="rules.toml")
    with pytest.raises(
        InputError, match=r"wallet-1, egg-1 and egg-2 are fit by no rule of rules\.toml; add a last rule"
    ):
        assign_splits(plan, TABLE)


def test_a_trial_cannot_be_in_two_splits():
    twice = [fact("cup-1", day=1), fact("cup-1", day=2), fact("egg-1")]
    plan = SplitPlan(rules=(SplitRule(day=(1,), name="train"), SplitRule(name="test")))
    with pytest.raises(InputError, match="cup-1 is listed more than once; a trial belongs to one split"):
        assign_splits(plan, twice)


# worked out by hand: parts of the groups, whole parts, remainders
@pytest.mark.parametrize(
    ("count", "share", "expected"),
    [
        (10, (0.8, 0.1, 0.1), (8, 1, 1)),
        (10, (0.7, 0.15, 0.15), (7, 2, 1)),  # 7, 1.5, 1.5: of two equal remainders the first named wins
        (20, (0.7, 0.15, 0.15), (14, 3, 3)),
        (7, (0.5, 0.3, 0.2), (4, 2, 1)),  # 3.5, 2.1, 1.4
        (8, (0.7, 0.1, 0.2), (6, 1, 1)),  # 5.6, 0.8, 1.6: floating point would break the tie the other way
        (3, (0.8, 0.1, 0.1), (1, 1, 1)),  # 2.4, 0.3, 0.3 are 3, 0, 0: none goes without
        (5, (0.9, 0.05, 0.05), (3, 1, 1)),  # 4.5, 0.25, 0.25 are 5, 0, 0
        (2, (0.1, 0.2, 0.7), (0, 1, 1)),  # 0.2, 0.4, 1.4: too few groups for all
        (1, (0.25, 0.5, 0.25), (0, 1, 0)),
        (100, (0.29, 0.71, 0.0), (29, 71, 0)),  # 0.29 * 100 is 28.999999999999996 in floating point
    ],
)
def test_shares_of_groups_by_hand(count: int, share: tuple[float, ...], expected: tuple[int, ...]):
    named = {name: part for name, part in zip(("train", "validation", "test"), share, strict=True) if part}
    found = Counter(assign_splits(shares("trial", named), groups_of_one(count)).splits)
    assert tuple(found[name] for name in ("train", "validation", "test")) == expected


WEIGHTS = st.lists(st.integers(1, 20), min_size=1, max_size=5)


def as_shares(weights: list[int]) -> dict[str, float]:
    return {f"s{index}": weight / sum(weights) for index, weight in enumerate(weights)}


@given(count=st.integers(1, 60), weights=WEIGHTS, seed=st.integers(0, 9))
def test_every_split_has_its_share_within_one_group(count: int, weights: list[int], seed: int):
    share = as_shares(weights)
    found = Counter(assign_splits(shares("trial", share, seed=seed), groups_of_one(count)).splits)
    assert sum(found.values()) == count
    if count >= len(share):
        assert all(found[split] >= 1 for split in share)
    # where every split is due a group nobody has to give one up
    if all(count * weight >= sum(weights) for weight in weights):
        assert all(abs(found[split] - count * part) < 1 for split, part in share.items())


TRIALS = st.lists(
    st.builds(
        fact,
        st.text(st.characters(codec="utf-8"), min_size=1, max_size=4),
        day=st.integers(1, 4),
        object=st.sampled_from(["cup", "egg", "walnut"]),
        condition=st.sampled_from(["dry", "wet"]),
        sensor=st.sampled_from(["a", "b"]),
    ),
    min_size=1,
    max_size=12,
    unique_by=lambda one: one.trial,
)


@given(TRIALS, WEIGHTS, st.sampled_from(["trial", "day", "object", "condition", "sensor"]), st.integers(0, 3))
def test_a_group_is_never_torn_apart(trials: list[TrialFacts], weights: list[int], by: str, seed: int):
    splits = assign_splits(shares(by, as_shares(weights), seed=seed), trials).splits
    of_group: dict[object, set[str]] = {}
    for trial, split in zip(trials, splits, strict=True):
        of_group.setdefault(getattr(trial, by), set()).add(split)
    assert all(len(found) == 1 for found in of_group.values())


@given(st.data(), TRIALS, st.sampled_from(["trial", "day", "object"]))
def test_the_order_of_the_trials_plays_no_part(data: st.DataObject, trials: list[TrialFacts], by: str):
    dealing = SplitRule(share={"train": 0.5, "validation": 0.3, "test": 0.2}, by=by)
    plan = SplitPlan(rules=(SplitRule(day=(4,), name="test"), dealing))
    shuffled = data.draw(st.permutations(trials))
    assert dealt(plan, shuffled) == dealt(plan, trials)
    assert set(assign_splits(plan, shuffled).notes) == set(assign_splits(plan, trials).notes)
    if len({one.day for one in trials}) > 1:
        assert dealt(PRESETS["thesis"](shuffled), shuffled) == dealt(PRESETS["thesis"](trials), trials)


def test_more_trials_of_an_object_move_no_other():
    plan = shares("object", {"train": 0.5, "test": 0.5})
    more = [*TABLE, fact("egg-3", object="egg"), fact("egg-4", object="egg", day=9)]
    before, after = dealt(plan, TABLE), dealt(plan, more)
    assert {name: after[name] for name in before} == before


@pytest.mark.parametrize("count", range(10, 40))
def test_a_new_group_moves_few_others(count: int):
    plan = shares("trial", {"train": 0.7, "validation": 0.15, "test": 0.15})
    before, after = dealt(plan, groups_of_one(count)), dealt(plan, groups_of_one(count + 1))
    # each of two borders lies within one group of its exact place, which moves by less than one; the groups beside it
    # stay or move by one: at most two cross it
    assert sum(before[name] != after[name] for name in before) <= 4


def test_groups_are_dealt_in_the_order_of_their_hash():
    def place(name: str) -> bytes:
        return hashlib.sha256(f"5:{name}".encode()).digest()

    trials = groups_of_one(9)
    order = sorted((one.trial for one in trials), key=place)
    found = dealt(shares("trial", {"train": 2 / 3, "test": 1 / 3}, seed=5), trials)
    assert [found[name] for name in order] == ["train"] * 6 + ["test"] * 3


def test_over_the_seeds_each_group_tests_as_often():
    trials = groups_of_one(4)
    tests = Counter()
    for seed in range(400):
        found = dealt(shares("trial", {"train": 0.75, "test": 0.25}, seed=seed), trials)
        tests += Counter(name for name, split in found.items() if split == "test")
    # one of four tests each time: 100 of 400, five standard deviations of 400 draws at 1/4 are 43
    assert sum(tests.values()) == 400
    assert all(abs(tests[one.trial] - 100) < 43 for one in trials)


def facts_of(recipe: SimulationRecipe) -> tuple[list[TrialFacts], tuple[str, ...]]:
    plans = plan_trials(recipe)
    trials = [fact(plan.trial, day=plan.day, condition=plan.condition) for plan in plans]
    return trials, tuple(plan.split for plan in plans)


@pytest.mark.parametrize("recipe", [RECIPES["small"], RECIPES["thesis"]], ids=["small", "thesis"])
def test_the_preset_thesis_splits_as_the_simulator_does(recipe: SimulationRecipe):
    trials, expected = facts_of(recipe)
    result = assign_splits(PRESETS["thesis"](trials), trials)
    assert result.splits == expected
    assert result.notes == ()


@given(st.integers(3, 90), st.integers(0, 5), st.integers(2, 9))
def test_the_preset_thesis_follows_any_recipe(dry: int, wet: int, days: int):
    recipe = SimulationRecipe(dry_trials=dry, wet_trials=wet, days=days)
    trials, expected = facts_of(recipe)
    if expected.count("test") == 0 or {one.day for one in trials} == {1}:
        return  # a day without trials is no day of the data
    assert assign_splits(PRESETS["thesis"](trials), trials).splits == expected


def test_the_preset_thesis_orders_more_than_999_trials_a_day():
    trials, expected = facts_of(SimulationRecipe(dry_trials=(1, 1003, 2, 1), days=4))
    assert assign_splits(PRESETS["thesis"](trials), trials).splits == expected


def test_the_thesis_by_hand():
    trials = [fact(f"d{day}-{number}", day=day) for day in (3, 5, 8, 9) for number in (1, 2, 10, 11)]
    trials += [fact("d5-wet", day=5, condition="wet"), fact("d9-wet", day=9, condition="wet")]
    found = dealt(PRESETS["thesis"](trials), trials)
    # candidates: d5-1 d5-2 d5-10 d5-11 d8-1 d8-2 d8-10 d8-11; two of eight, at places 0.5 * 4 and 1.5 * 4
    assert {name for name, split in found.items() if split == "validation"} == {"d5-10", "d8-10"}
    assert {name for name, split in found.items() if split == "test"} == {"d9-1", "d9-2", "d9-10", "d9-11", "d9-wet"}
    assert found["d5-wet"] == "train"


@pytest.mark.parametrize("order", [("a1", "a01"), ("a01", "a1")])
def test_names_alike_to_the_natural_order_have_one_order_too(order: tuple[str, str]):
    trials = [fact("first"), *(fact(name, day=2) for name in order), fact("last", day=3)]
    assert dealt(PRESETS["thesis"](trials), trials)["a1"] == "validation"


def test_names_with_wildcards_are_taken_by_the_letter():
    trials = [fact(name, day=day) for day, name in ((1, "a"), (2, "1"), (2, "[b]"), (2, "b"), (3, "c"))]
    # the middle one of 1, [b] and b validates
    expected = {"a": "train", "1": "train", "[b]": "validation", "b": "train", "c": "test"}
    assert dealt(PRESETS["thesis"](trials), trials) == expected


def test_the_thesis_needs_a_second_day():
    with pytest.raises(InputError, match="tests on the last day, but there is only day 7; split by another preset"):
        PRESETS["thesis"]([fact("a", day=7), fact("b", day=7)])


@pytest.mark.parametrize(("preset", "by"), [("objects", "object"), ("trials", "trial")])
def test_a_preset_is_a_file_of_one_rule(tmp_path: Path, preset: str, by: str):
    plan = written(tmp_path, f'[[split]]\nshare = {{ train = 0.7, validation = 0.15, test = 0.15 }}\nby = "{by}"\n')
    assert PRESETS[preset](TABLE).rules == plan.rules


def test_what_is_odd_is_told():
    plan = SplitPlan(
        rules=(
            SplitRule(object=("cup",), name="test"),
            SplitRule(object=("cpu",), day=(1, 2), name="validation"),
            SplitRule(trial=("cup-2",), name="validation"),
            SplitRule(name="train"),
        ),
        source="rules.toml",
    )
    assert assign_splits(plan, TABLE).notes == (
        "rule 2 of rules.toml (day 1 or 2, object cpu) decides nothing: no trial fits it; check its words",
        "rule 3 of rules.toml (trial cup-2) decides nothing: rules before it take every trial it fits",
        "no trial is in validation: to train takes train and validation, to evaluate test",
        "day 2 is in train and test: the test does not tell of a new day",
    )


def test_an_object_in_train_and_test_is_told():
    plan = SplitPlan(rules=(SplitRule(trial=("*-2",), name="test"), SplitRule(name="train")))
    assert (
        "objects cup and egg are in train and test: the test does not tell of a new object"
        in assign_splits(plan, TABLE).notes
    )


def test_too_few_groups_are_told():
    trials = [fact("a", object="cup"), fact("b", object="cup"), fact("c")]
    notes = assign_splits(shares("object", {"train": 0.5, "validation": 0.3, "test": 0.2}), trials).notes
    assert "rule 1 of the plan has 2 objects to deal to 3 splits; test got none" in notes
    assert "rule 1 of the plan: the object of c is not told; dealt as if of one object" in notes


def test_trials_without_objects_are_not_dealt_by_object():
    with pytest.raises(InputError, match="deals by object, but of t0 and t1 it is not told; tell it on import"):
        assign_splits(PRESETS["objects"]([]), groups_of_one(2))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[split]]\nname = test", r"rules\.toml is not valid TOML: .*line 2.*; mend it there"),
        ("", r"rules\.toml has no rule; write one that begins with \[\[split\]\]"),
        ("day = 4\n", r"has 'day' outside of a rule; put it under a line \[\[split\]\]"),
        ('[split]\nname = "test"', r"has a split that is no list of rules; begin each rule with \[\[split\]\]"),
        ('[[split]]\nname = "train"\n[[split]]\nobjekt = "cup"', "rule 2: 'objekt' is no key of a rule; use trial, "),
        ("[[split]]\nday = 4", "rule 1: it has neither name nor share; give"),
        ('[[split]]\nname = "test"\nshare = { test = 1 }\nby = "day"', "rule 1: it has both name and share; give"),
        ('[[split]]\nname = "Test"', "rule 1: a split cannot be named 'Test'; use a lower-case word"),
        ('[[split]]\nshare = { "my test" = 1.0 }\nby = "day"', "rule 1: a split cannot be named 'my test'"),
        ('[[split]]\nname = ["test"]', r"rule 1: name is \['test'\]; give one text in quotes"),
        ('[[split]]\nname = "test"\nday = "4"', "rule 1: day is '4'; give a whole number, or a list"),
        ('[[split]]\nname = "test"\nday = [4, true]', r"rule 1: day is \[4, True\]; give a whole number"),
        ('[[split]]\nname = "test"\nobject = 4', "rule 1: object is 4; give a text in quotes"),
        ('[[split]]\nname = "test"\nobject = []', "rule 1: object is an empty list, which fits no trial; name some"),
        ('[[split]]\nname = "test"\nby = "day"', "rule 1: by goes with share; leave it out"),
        ('[[split]]\nname = "test"\nseed = 1', "rule 1: seed goes with share; leave it out"),
        ("[[split]]\nshare = { train = 1 }", "rule 1: share needs by; choose trial, day, object, condition or sensor"),
        ('[[split]]\nshare = { train = 1 }\nby = "frame"', "rule 1: trials cannot be grouped by 'frame'; choose trial"),
        ('[[split]]\nshare = { train = 1 }\nby = "day"\nseed = 0.5', "rule 1: seed is 0.5; give a whole number"),
        ('[[split]]\nshare = { train = 1.2, test = -0.2 }\nby = "day"', "rule 1: the share of test is -0.2; give more"),
        ('[[split]]\nshare = { train = nan }\nby = "day"', "rule 1: the share of train is nan; give more than 0"),
        ('[[split]]\nshare = { train = 1, test = 0 }\nby = "day"', "rule 1: the share of test is 0; .* leave test out"),
        ('[[split]]\nshare = { train = 0.8, test = 0.1 }\nby = "day"', "rule 1: the shares sum to 0.9; change them"),
        ('[[split]]\nshare = 0.8\nby = "day"', "rule 1: share is 0.8; write it like { train = 0.8, validation = 0.2 }"),
        ('[[split]]\nshare = { train = "all" }\nby = "day"', "rule 1: share is .*; write it like"),
    ],
)
def test_a_mistake_in_the_file_is_told_with_its_rule(tmp_path: Path, text: str, message: str):
    with pytest.raises(InputError, match=message) as raised:
        written(tmp_path, text)
    assert str(tmp_path / "rules.toml") in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_file_that_cannot_be_read_is_told(tmp_path: Path):
    for path in (tmp_path / "nothing.toml", tmp_path):
        with pytest.raises(InputError, match=r"is a folder, not a file|does not exist; name a TOML file of rules"):
            read_splits(path)
    (tmp_path / "latin.toml").write_bytes('[[split]]\nname = "train"\nobject = "Nuß"'.encode("latin-1"))
    with pytest.raises(InputError, match=r"latin\.toml is not valid TOML: "):
        read_splits(tmp_path / "latin.toml")


def test_a_file_of_a_windows_editor_is_read(tmp_path: Path):
    path = tmp_path / "rules.toml"
    path.write_bytes('[[split]]\r\nname = "train"\r\nobject = "Nuß"\r\n'.encode("utf-8-sig"))
    assert read_splits(path).rules == (SplitRule(object=("Nuß",), name="train"),)


@pytest.fixture
def data(tmp_path: Path, small_dataset: Dataset) -> Dataset:
    shutil.copytree(small_dataset.folder, tmp_path / "data")
    return load_dataset(tmp_path / "data")


def test_nothing_of_a_data_set_changes_but_its_splits(data: Dataset):
    before = json.loads((data.folder / DATASET_FILE).read_text())
    plan = SplitPlan(rules=(SplitRule(day=(2, 3), name="test"), SplitRule(name="train")))
    split_dataset(data, plan)
    stored = load_dataset(data.folder)
    assert [info.split for info in stored.trials] == ["test" if info.day in {2, 3} else "train" for info in data.trials]
    assert [replace(info, split="") for info in stored.trials] == [replace(info, split="") for info in data.trials]
    after = json.loads((data.folder / DATASET_FILE).read_text())
    assert {name: after[name] for name in after if name != "trials"} == {
        name: before[name] for name in before if name != "trials"
    }
    assert stored.simulated
    assert check_dataset(data.folder) == ()
    assert not list(data.folder.glob("*.part"))


def test_the_rules_are_kept_as_their_file_said_them(data: Dataset, tmp_path: Path):
    text = """
        [[split]]
        name = "test"
        day = 4
        [[split]]
        share = { train = 0.8, validation = 0.2 }
        by = "trial"
        seed = 3
        """
    plan = written(tmp_path, text)
    result = split_dataset(data, plan)
    record = json.loads((data.folder / SPLITS_FILE).read_text())
    assert record["rules"] == [
        {"day": [4], "name": "test"},
        {"share": {"train": 0.8, "validation": 0.2}, "by": "trial", "seed": 3},
    ]
    assert record["source"] == str(tmp_path / "rules.toml")
    assert record["splits"] == {info.trial: info.split for info in load_dataset(data.folder).trials}
    assert record["notes"] == list(result.notes)


def test_a_dry_run_tells_the_splits_and_writes_nothing(data: Dataset):
    before = contents(data.folder)
    result = split_dataset(data.folder, "thesis", dry_run=True)
    assert contents(data.folder) == before
    assert result == split_dataset(data, "thesis")
    assert tuple(info.split for info in load_dataset(data.folder).trials) == result.splits
