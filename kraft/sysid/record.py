"""What a vehicle file records of an identification, and which versions shaped it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kraft.provenance import IDENTIFICATION, versions
from kraft.sysid.forecast import Predicted
from kraft.sysid.holdout import Split
from kraft.sysid.result import Identification, PredictionErrors
from kraft.vehicles.config import Covariance, Extra, IdentificationRecord, Logged, PoseNoise, Prediction

if TYPE_CHECKING:
    from kraft.logs.log import Log


def record_of(
    started_from: str,
    identification: Identification,
    split: Split,
    predicted: Predicted,
) -> IdentificationRecord:
    """Record an identification.

    Args:
        started_from: the vehicle that was asked for.
        identification: what came out.
        split: the logs that were fitted and held out.
        predicted: how far their predictions are off.
    """
    unseen = predicted.held_out
    matrix = tuple(tuple(map(float, row)) for row in identification.covariance)
    return IdentificationRecord(
        started_from=started_from,
        interval=identification.interval,
        covariance=Covariance(names=identification.names, matrix=matrix),
        extras={name: _extra(identification, name) for name in identification.extras},
        noise=PoseNoise(
            position=identification.noise.position,
            yaw=identification.noise.yaw,
            measured=identification.noise_measured,
        ),
        fitted=_prediction(predicted.fitted.errors),
        held_out=None if unseen is None else _prediction(unseen.errors),
        held_out_before=None if unseen is None else _prediction(unseen.errors_before),
        warnings=identification.warnings,
        logs=(*_logged(split.fitted, held_out=False), *_logged(split.held_out, held_out=True)),
        versions=versions(IDENTIFICATION),
    )


def _extra(identification: Identification, name: str) -> Extra:
    estimate = identification.parameters[name]
    return Extra(value=estimate.value, unit=estimate.unit, std=estimate.std, description=estimate.description)


def _prediction(errors: PredictionErrors) -> Prediction:
    return Prediction(
        position=tuple(errors.position[t] for t in sorted(errors.position)),
        yaw=tuple(errors.yaw[t] for t in sorted(errors.yaw)),
        overall_position=errors.overall_position,
        overall_yaw=errors.overall_yaw,
    )


def _logged(logs: Sequence[Log], *, held_out: bool) -> list[Logged]:
    return [Logged(name=log.name, held_out=held_out, files=_files(log)) for log in logs]


def _files(log: Log) -> dict[str, str]:
    """SHA-256 by file name, which says the same wherever the logs are; by path where two have the same name."""
    names = [Path(source.file).name for source in log.sources]
    unique = len(set(names)) == len(names)
    return {(Path(s.file).name if unique else s.file): s.sha256 for s in log.sources}
