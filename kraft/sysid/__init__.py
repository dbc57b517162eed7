"""System identification: the parameters of a vehicle model from logs of commands and poses (paper, Sec. IV-A).

identify(vehicle, logs, settings)                  parameters, intervals, warnings, smoothed states
prediction_errors(vehicle, logs, values, settings) how far open-loop prediction is off
errors_by_speed(windows)                           the same by speed, as a vehicle file states it

Names are imported when they are first used: a vehicle that drives needs only the factor graph.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from kraft.sysid.acceptance import errors_by_speed as errors_by_speed
    from kraft.sysid.identify import identify as identify
    from kraft.sysid.interface import Identification as Identification
    from kraft.sysid.interface import LogFit as LogFit
    from kraft.sysid.interface import Noise as Noise
    from kraft.sysid.interface import ParameterEstimate as ParameterEstimate
    from kraft.sysid.interface import PartFit as PartFit
    from kraft.sysid.interface import PredictionErrors as PredictionErrors
    from kraft.sysid.interface import Settings as Settings
    from kraft.sysid.prediction import Window as Window
    from kraft.sysid.prediction import predict_windows as predict_windows
    from kraft.sysid.prediction import prediction_errors as prediction_errors

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "acceptance": ["errors_by_speed"],
        "identify": ["identify"],
        "interface": [
            "Identification", "LogFit", "Noise", "ParameterEstimate", "PartFit", "PredictionErrors", "Settings"
        ],
        "prediction": ["Window", "predict_windows", "prediction_errors"],
    },
)  # fmt: skip
