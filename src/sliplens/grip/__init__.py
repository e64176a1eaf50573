"""Grips that hold what would slip, with the safety margin in the loop: simulated, and out to a real gripper."""

from sliplens.grip.controllers import CONTROLLERS, Controller, Observation
from sliplens.grip.fingertip import Fingertip
from sliplens.grip.loop import Eyes, GripLoop, RenderedEyes, Sight, SlipWatch, TableEyes, Tick
from sliplens.grip.plant import OBJECTS, GripperModel, HeldObject, Plant, PlantState, World
from sliplens.grip.readings import ReadingTable, measure_readings
from sliplens.grip.scripts import CONDITIONS, Scripts, draw_scripts, pick_object
