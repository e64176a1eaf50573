"""Data sets worth a name."""

from sliplens.simulation.nuisances import Nuisances
from sliplens.simulation.plan import FrameTotals, SimulationRecipe

PRESETS = {
    "small": SimulationRecipe(dry_trials=96, wet_trials=8, frames_per_trial=48, days=12),
    "thesis": SimulationRecipe(
        # 160 training, 20 validation and 21 test trials of about 800 frames
        dry_trials=(100, 40, 40, 11),
        wet_trials=10,
        frames_per_trial=800,
        frame_totals=FrameTotals(train=128_043, validation=15_839, test=16_875),
        days=4,
    ),
    "varied": SimulationRecipe(
        # many short trials, each day with three: of long ones a network learns the trials by heart
        dry_trials=2460,
        wet_trials=60,
        frames_per_trial=20,
        days=820,
        test_days=20,
        validation_share=0.1,
        sensors=200,
        nuisances=Nuisances(dry_friction=(0.15, 1.2)),
    ),
}
"""`small` fits a laptop and shows many days; `thesis` has the days, splits and number of frames of the thesis: Polak,
*Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*. It does not say how many trials it
had, nor how dry and wet shared the test day: that is assumed, from about 800 frames a trial. `varied` is for networks
that are to meet other days, sensors and objects."""
