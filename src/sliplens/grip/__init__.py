"""Grips that hold an object by its safety margin: simulated, and with a real gripper."""
