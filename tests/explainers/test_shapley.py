"""Shapley values against their definition, on games whose values are known."""

from math import comb

import numpy as np
import pytest
import torch
from quick import Count
from small import Returning
from torch import Tensor, nn

from sliplens.errors import InputError
from sliplens.explainers.occlusion import tile_regions
from sliplens.explainers.shapley import Shapley, shapley_values
from sliplens.explainers.table import get_explainer


def by_definition(value, players: int) -> np.ndarray:
    """What a player adds to each coalition without him, by how often that one has come before him."""
    every = (np.arange(2**players)[:, None] >> np.arange(players) & 1).astype(bool)
    worth, before = value(every), every.sum(axis=1)
    orders = np.array([1 / (players * comb(players - 1, size)) for size in range(players)])
    without = [np.flatnonzero(~every[:, player]) for player in range(players)]
    return np.array(
        [
            (orders[before[rows]] * (worth[rows | 1 << player] - worth[rows])).sum()
            for player, rows in enumerate(without)
        ]
    )


def random_game(players: int, *, seed: int):
    worth = np.random.default_rng(seed).normal(size=2**players)
    return lambda members: worth[members @ (1 << np.arange(players))]


@pytest.mark.parametrize("players", [2, 3, 5, 9, 12])
def test_all_coalitions_of_a_dozen_players_tell_as_their_definition_does(players: int) -> None:
    game = random_game(players, seed=players)

    found = shapley_values(game, players, pairs=max(32, 2 ** (players - 1)), rng=np.random.default_rng(0))

    np.testing.assert_allclose(found.values, by_definition(game, players), atol=1e-12)
    assert not found.standard_errors.any()


def test_one_player_is_worth_the_whole() -> None:
    found = shapley_values(lambda members: 3.0 * members[:, 0] - 1, 1, pairs=1, rng=np.random.default_rng(0))

    assert found.values.tolist() == [3.0]


def test_sampled_values_of_pairwise_games_are_exact() -> None:
    """Pairs of coalitions tell the odd part alone; of a game of pairs it is linear, and each gets half of a pair."""
    rng = np.random.default_rng(1)
    alone, together = rng.normal(size=24), np.triu(rng.normal(size=(24, 24)), 1)

    def game(members: np.ndarray) -> np.ndarray:
        taking = members.astype(float)
        return taking @ alone + np.einsum("ni,ij,nj->n", taking, together, taking)

    found = shapley_values(game, 24, pairs=60, rng=rng)

    np.testing.assert_allclose(found.values, alone + (together + together.T).sum(axis=1) / 2, atol=1e-10)


def glove(members: np.ndarray) -> np.ndarray:
    """A pair of gloves is worth 1: the first 8 players hold left ones, the other 22 right ones."""
    return np.minimum(members[:, :8].sum(axis=1), members[:, 8:].sum(axis=1)).astype(float)


def glove_values() -> np.ndarray:
    """What a holder adds where she comes after each number of lefts and rights, by how often that happens."""

    def side(own: int, other: int) -> float:
        total = 0.0
        for mine in range(own):
            for theirs in range(other + 1):
                before = mine + theirs
                chance = comb(own - 1, mine) * comb(other, theirs) / comb(own + other - 1, before) / (own + other)
                total += chance * (theirs > mine)
        return total

    return np.array([side(8, 22)] * 8 + [side(22, 8)] * 22)


@pytest.mark.parametrize("kind", ["none", "good", "fair", "poor"])
def test_sampled_values_come_near_and_their_errors_are_as_large_as_they_say(kind: str) -> None:
    """Far from any game of pairs, with and without a guess; one that is the truth but for its size is scaled.

    Of 40 x 30 errors, of which about 30 a draw hang together, the ratio's own spread is some 10 %.
    """
    truth, scaled, errors = glove_values(), [], []
    assert truth.sum() == pytest.approx(8)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        noise = rng.normal(size=30) * np.std(truth)
        guess = {"good": 3 * truth + 1e-3 * noise, "fair": truth + 0.3 * noise, "poor": noise}.get(kind)
        found = shapley_values(glove, 30, pairs=200, rng=rng, guess=guess)
        assert found.values.sum() == pytest.approx(8)
        errors.append(found.values - truth)
        scaled.append(errors[-1] / found.standard_errors)

    assert np.sqrt(np.mean(np.square(scaled))) == pytest.approx(1, abs=0.3)
    if kind == "none":
        assert np.abs(np.mean(errors, axis=0)).max() < 5 * np.std(errors) / np.sqrt(40)


def test_players_without_part_get_nothing_and_twins_the_same() -> None:
    """Axioms of the dummy and of symmetry, on average over draws within five standard errors."""

    def game(members: np.ndarray) -> np.ndarray:
        return np.tanh(members[:, 0] * 1.0 + members[:, 1] + members[:, 2:20].sum(axis=1) / 6 - 2)

    found = shapley_values(game, 25, pairs=400, rng=np.random.default_rng(3))

    assert np.abs(found.values[20:] / found.standard_errors[20:]).max() < 5
    apart = abs(found.values[0] - found.values[1]) / np.hypot(*found.standard_errors[:2])
    assert apart < 5


def test_too_few_pairs_are_refused() -> None:
    with pytest.raises(InputError, match="59 pairs of coalitions cannot distinguish 30 players; use at least 60"):
        shapley_values(glove, 30, pairs=59, rng=np.random.default_rng(0))


class Tiles(nn.Module):
    """A game of four tiles of 2 x 2 pixels: products and sums of their means."""

    def forward(self, images: Tensor) -> Tensor:
        means = nn.functional.avg_pool2d(images.mean(dim=1, keepdim=True), 2).flatten(1)
        return means[:, 0] * means[:, 1] - 2 * means[:, 2] + means[:, 3] * means[:, 0] * means[:, 1]


def test_a_map_shares_out_the_change_among_the_tiles() -> None:
    image, reference = torch.rand(2, 3, 4, 4, generator=torch.Generator().manual_seed(0)).unbind()
    explanation = Shapley(tile_px=2)(Tiles(), image[None], reference=reference)
    regions = tile_regions((4, 4), tile_px=2)

    def game(members: np.ndarray) -> np.ndarray:
        taking = torch.from_numpy(members)[:, regions.flatten()].view(-1, 1, 4, 4)
        return Tiles()(torch.where(taking, image, reference)).double().numpy()

    expected = torch.from_numpy(by_definition(game, 4) / 4).float()[regions]
    torch.testing.assert_close(explanation.relevance[0], expected, atol=1e-6, rtol=0)
    assert explanation.completeness_gap is not None
    assert float(explanation.completeness_gap.max()) < 1e-6


def test_markers_are_players_and_what_lies_between_them_is_one_more() -> None:
    """Centres in the middle of each tile that reach half of the way: the rest moves nothing, and gets nothing."""
    centres = torch.tensor([[0.5, 0.5], [2.5, 0.5], [0.5, 2.5], [2.5, 2.5]])
    image = torch.rand(1, 3, 4, 4, generator=torch.Generator().manual_seed(1))
    by_marker = get_explainer("shapley-marker", markers_px=centres)(Tiles(), image)
    by_tile = Shapley(tile_px=2)(Tiles(), image)

    assert by_marker.method == "shapley-marker"
    torch.testing.assert_close(by_marker.relevance, by_tile.relevance, atol=1e-6, rtol=0)


def test_the_first_guess_costs_few_passes_beside_those_of_the_coalitions() -> None:
    """A step that no gradient follows, where Integrated Gradients that have to be complete go on to their last step."""
    cliff = Count(Returning(lambda images: torch.sigmoid(1e4 * (images.mean(dim=(1, 2, 3)) - 0.5))))
    explanation = Shapley(tile_px=1, pairs=64)(cliff, torch.ones(1, 3, 5, 5))

    torch.testing.assert_close(explanation.relevance.sum(dim=(1, 2)), explanation.change)
    assert sum(cliff.batches) <= 2 * 64 + 32


def test_uncertain_contributions_are_told() -> None:
    """A network that answers with the parity of its tiles is beyond what few coalitions tell."""
    parity = Returning(lambda images: images[:, 0].flatten(1).round().sum(dim=1) % 2)
    explanation = Shapley(tile_px=1, pairs=72)(parity, torch.ones(1, 3, 5, 7))

    assert any("hardly surer than they differ" in warning for warning in explanation.warnings)


def errors_on_gloves(guess: np.ndarray | None) -> np.ndarray:
    """Root mean square error of each of 12 draws of 100 pairs."""
    found = [shapley_values(glove, 30, pairs=100, rng=np.random.default_rng(seed), guess=guess) for seed in range(12)]
    for one in found:
        assert one.values.sum() == pytest.approx(8)
    return np.array([np.sqrt(np.mean((one.values - glove_values()) ** 2)) for one in found])


def test_a_good_guess_saves_pairs_and_a_poor_one_costs_little() -> None:
    plain = errors_on_gloves(None).mean()
    rng = np.random.default_rng(0)

    assert errors_on_gloves(3 * glove_values() + 0.01 * rng.normal(size=30)).mean() < plain / 2
    assert errors_on_gloves(rng.normal(size=30)).mean() < 1.1 * plain


def test_a_wrong_guess_cannot_bend_what_the_coalitions_say() -> None:
    """A game without noise: each plays for himself alone."""
    rng = np.random.default_rng(2)
    alone = rng.normal(size=24)

    found = shapley_values(lambda members: members @ alone, 24, pairs=60, rng=rng, guess=rng.normal(size=24))

    np.testing.assert_allclose(found.values, alone, atol=1e-4)
