"""How labels were made, with all that can be told and numbers that no rounding keeps."""

from sliplens.recordings.labelling import (
    ForceAxes,
    FrictionEstimate,
    LabelBasis,
    Labelling,
    Lag,
    ReferenceChoice,
)

LABELLING = Labelling(
    source="Prüfstand ‰",
    forces=None,
    notes=("Grüße\u2028",),
    reference=ReferenceChoice(index=4, method="named"),
    basis=LabelBasis(
        axes=ForceAxes(
            normal="z",
            sign=-1,
            tare_n=(0.1 + 0.2, -1e-300, 0.0),
            noise_n=(0.1, 0.2, 0.3),
            tare_sigma_n=(1 / 3, 0.0, 0.0),
            still_until_s=None,
        ),
        friction=FrictionEstimate(mu=0.3, low=0.2, high=0.4),
        slip_s=None,
        lag=Lag(lag_s=0.1, sigma_s=1 / 3),
        lag_applied=False,
        contact_threshold_n=0.1,
    ),
)
