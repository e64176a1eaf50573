"""Splits: whole groups, their shares, the same on every machine; tables, and what is refused."""

import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplens.errors import InputError
from sliplens.recordings import Dataset, TrialFacts, check_dataset, load_dataset
from sliplens.recordings.dataset import DATASET_FILE
from sliplens.recordings.splits import SPLITS, Group, assign_splits, read_split_table, split_by_group, split_dataset

GROUPS = st.sampled_from(["trial", "object", "day"])


def fact(trial: str, *, day: int = 1, object: str = "", condition: str = "dry") -> TrialFacts:
    return TrialFacts(trial=trial, day=day, object=object, condition=condition)


def singles(count: int) -> list[TrialFacts]:
    return [fact(f"t{index}") for index in range(count)]


def dealt(trials: list[TrialFacts], by: Group = "trial", *, seed: int = 0) -> dict[str, str]:
    return dict(zip((one.trial for one in trials), split_by_group(trials, by=by, seed=seed).splits, strict=True))


LAB = [
    fact("cup-1", object="cup", day=1),
    fact("cup-2", object="cup", day=2, condition="wet"),
    fact("walnut-1", object="walnut", day=2),
    fact("wallet-1", object="wallet", day=3, condition="wet"),
    fact("egg-1", object="egg", day=3),
    fact("egg-2", object="egg", day=4),
]


# worked out by hand: parts of the groups, whole parts, remainders
@pytest.mark.parametrize(
    ("count", "shares", "expected"),
    [
        (10, (0.8, 0.1, 0.1), (8, 1, 1)),
        (10, (0.7, 0.15, 0.15), (7, 2, 1)),  # 7, 1.5, 1.5: of two equal remainders the first split wins
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
def test_shares_of_groups_by_hand(count: int, shares: tuple[float, float, float], expected: tuple[int, ...]):
    counts = Counter(split_by_group(singles(count), by="trial", shares=shares).splits)
    assert tuple(counts[name] for name in SPLITS) == expected


@given(st.integers(1, 60), st.tuples(*[st.integers(0, 20)] * 3).filter(any), st.integers(0, 9))
def test_every_split_has_its_share_within_one_group(count: int, weights: tuple[int, int, int], seed: int):
    train, validation, test = (weight / sum(weights) for weight in weights)
    shares = (train, validation, test)
    counts = Counter(split_by_group(singles(count), by="trial", shares=shares, seed=seed).splits)
    assert sum(counts.values()) == count
    named = [(split, share) for split, share in zip(SPLITS, shares, strict=True) if share]
    assert {*counts} <= {split for split, _ in named}
    if count >= len(named):
        assert all(counts[split] >= 1 for split, _ in named)
    # where every split is due a group none has to give one up
    if all(count * share >= 1 for _, share in named):
        assert all(abs(counts[split] - count * share) < 1 for split, share in named)


TRIALS = st.lists(
    st.builds(
        fact,
        st.text(st.characters(codec="utf-8"), min_size=1, max_size=4),
        day=st.integers(1, 4),
        object=st.sampled_from(["cup", "egg", "walnut"]),
    ),
    min_size=1,
    max_size=12,
    unique_by=lambda one: one.trial,
)


@given(st.data(), TRIALS, GROUPS, st.integers(0, 3))
def test_a_group_stays_whole_and_the_order_of_the_trials_does_not_matter(
    data: st.DataObject, trials: list[TrialFacts], by: Group, seed: int
):
    splits = dealt(trials, by, seed=seed)
    of_group: dict[object, set[str]] = {}
    for trial in trials:
        of_group.setdefault(getattr(trial, by), set()).add(splits[trial.trial])
    assert all(len(names) == 1 for names in of_group.values())
    shuffled = data.draw(st.permutations(trials))
    assert dealt(shuffled, by, seed=seed) == splits
    assert set(split_by_group(shuffled, by=by).notes) == set(split_by_group(trials, by=by).notes)


def table(folder: Path, text: str) -> Path:
    (path := folder / "splits.csv").write_text(text, encoding="utf-8")
    return path


def test_the_first_row_that_matches_decides(tmp_path: Path):
    rows = read_split_table(table(tmp_path, "\ufefftrial;split\negg-2;spare\ncup[1]*;test\nwal?et-1;test\n*;train\n"))
    trials = [*LAB, fact("cup[1]*")]  # a name that looks like a pattern matches itself
    assert assign_splits(trials, rows).splits == ("train", "train", "train", "test", "train", "spare", "test")


def test_what_is_odd_is_noted():
    notes = assign_splits(LAB, {"egg-1": "test", "egg-*": "train", "egg-2": "test", "*": "train"}).notes
    assert notes == (
        "without effect in the table of splits: egg-2",
        "no trial is in validation: to train takes train and validation, to evaluate test",
        "object egg in both train and test: the test does not show how well a new object is predicted",
        "day 3 in both train and test: the test does not show how well a new day is predicted",
    )
    some = [replace(LAB[0], object=""), *LAB[1:]]
    assert "the object of cup-1 is unknown; split as one object" in split_by_group(some, by="object").notes


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("trial,split\n", "lists no trial; write a row"),
        ("trial,split,day\na,test,1\n", "has a column 'day'; a table of splits has trial, split"),
        ("trial,split\na,\n", "line 2: split is ''; use a lower-case word"),
        ("trial,split\na,Test set\n", "line 2: split is 'Test set'; use a lower-case word"),
        ("trial,split\na,test\na,train\n", "line 3: a has a row already; write one row a trial"),
    ],
)
def test_a_table_that_is_none_is_refused_with_its_cure(tmp_path: Path, text: str, error: str):
    with pytest.raises(InputError, match=error):
        read_split_table(table(tmp_path, text))


def test_trials_that_cannot_be_dealt_are_refused_with_their_cure():
    with pytest.raises(InputError, match=r"cup-1, cup-2, walnut-1 and wallet-1; add rows, or a last row for \*"):
        assign_splits(LAB, {"egg-*": "test"})
    with pytest.raises(InputError, match="the object of t0 and t1 is unknown; name it on import, or split by trial"):
        split_by_group(singles(2), by="object")
    for shares in ((0.5, 0.5, 0.5), (1.5, -0.5, 0.0), (float("nan"), 0.5, 0.5)):
        with pytest.raises(InputError, match="give three, none below 0, that sum to 1"):
            split_by_group(LAB, by="trial", shares=shares)


@pytest.fixture
def data(tmp_path: Path, small_dataset: Dataset) -> Dataset:
    shutil.copytree(small_dataset.folder, tmp_path / "data")
    return load_dataset(tmp_path / "data")


def test_nothing_of_a_data_set_changes_but_its_splits(data: Dataset):
    before = json.loads((data.folder / DATASET_FILE).read_text())
    result = split_dataset(data, "trial", dry_run=True)
    assert json.loads((data.folder / DATASET_FILE).read_text()) == before
    assert split_dataset(data, "trial") == result
    stored = load_dataset(data.folder)
    assert tuple(info.split for info in stored.trials) == result.splits
    assert [replace(info, split="") for info in stored.trials] == [replace(info, split="") for info in data.trials]
    after = json.loads((data.folder / DATASET_FILE).read_text())
    assert after | {"trials": 0} == before | {"trials": 0}
    assert check_dataset(data.folder) == ()
