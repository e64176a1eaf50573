"""Simulated trials of a marker-based fingertip, with exact labels."""

from sliplens.simulation.nuisances import Nuisances
from sliplens.simulation.plan import SimulationRecipe, TrialPlan, plan_trials
from sliplens.simulation.sensor import CHROMATOUCH, Sensor
from sliplens.simulation.trials import simulate_dataset, simulate_trial

__all__ = [
    "CHROMATOUCH",
    "Nuisances",
    "Sensor",
    "SimulationRecipe",
    "TrialPlan",
    "plan_trials",
    "simulate_dataset",
    "simulate_trial",
]
