"""System identification: the parameters of a vehicle model from logs of commands and poses (paper, Sec. IV-A).

identify(vehicle, logs, settings)                  parameters, intervals, warnings, smoothed states
prediction_errors(vehicle, logs, values, settings) how far open-loop prediction is off
"""

from kraft.sysid.identify import identify
from kraft.sysid.interface import Identification, LogFit, Noise, ParameterEstimate, PartFit, PredictionErrors, Settings
from kraft.sysid.prediction import Window, predict_windows, prediction_errors

__all__ = [
    "Identification",
    "LogFit",
    "Noise",
    "ParameterEstimate",
    "PartFit",
    "PredictionErrors",
    "Settings",
    "Window",
    "identify",
    "predict_windows",
    "prediction_errors",
]
