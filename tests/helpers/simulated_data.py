"""Simulated data sets of a recipe, with its record in their folder."""

from pathlib import Path

from sliplens.files import output_folder
from sliplens.recordings import Dataset, load_dataset
from sliplens.simulation import SimulationRecipe, simulate_dataset


def simulate_recipe(folder: Path, recipe: SimulationRecipe) -> Dataset:
    """Simulate a recipe into a folder, as `sl.simulate` does."""
    with output_folder(folder, stage="simulate", config={"recipe": recipe.to_json(), "device": "cpu"}) as output:
        simulate_dataset(output.folder, recipe)
    return load_dataset(folder)
