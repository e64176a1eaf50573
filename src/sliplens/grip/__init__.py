"""Grips that hold what would slip, with the safety margin in the loop: simulated, and out to a real gripper."""

from sliplens.grip.controllers import CONTROLLERS, Answer, Controller, Holder, Observation, make_controller
from sliplens.grip.episodes import run_episodes, run_scripts
from sliplens.grip.fingertip import Fingertip
from sliplens.grip.hold import HoldStep, hold_grip
from sliplens.grip.loop import Eyes, GripLoop, NoEyes, RenderedEyes, Sight, TableEyes, Tick
from sliplens.grip.plant import OBJECTS, GripperModel, HeldObject, Plant, PlantState, World, least_force, pick_object
from sliplens.grip.readings import ReadingTable, load_readings, measure_readings
from sliplens.grip.scripts import CONDITIONS, Scripts, draw_scripts
from sliplens.grip.source import GripSource

__all__ = [
    "CONDITIONS",
    "CONTROLLERS",
    "OBJECTS",
    "Answer",
    "Controller",
    "Eyes",
    "Fingertip",
    "GripLoop",
    "GripSource",
    "GripperModel",
    "HeldObject",
    "HoldStep",
    "Holder",
    "NoEyes",
    "Observation",
    "Plant",
    "PlantState",
    "ReadingTable",
    "RenderedEyes",
    "Scripts",
    "Sight",
    "TableEyes",
    "Tick",
    "World",
    "draw_scripts",
    "hold_grip",
    "least_force",
    "load_readings",
    "make_controller",
    "measure_readings",
    "pick_object",
    "run_episodes",
    "run_scripts",
]
