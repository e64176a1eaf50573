"""Simulated trials of a marker-based fingertip, with exact labels."""

from sliplens.simulation.nuisances import Nuisances
from sliplens.simulation.plan import PRESETS, SimulationRecipe, TrialPlan, make_recipe, plan_trials
from sliplens.simulation.sensor import CHROMATOUCH, FLAT_GEL, SENSORS, Sensor
from sliplens.simulation.trials import simulate, simulate_dataset, simulate_trial

__all__ = [
    "CHROMATOUCH", "FLAT_GEL", "PRESETS", "SENSORS", "Nuisances", "Sensor",
    "SimulationRecipe", "TrialPlan", "make_recipe", "plan_trials", "simulate",
    "simulate_dataset", "simulate_trial"
]  # fmt: skip
