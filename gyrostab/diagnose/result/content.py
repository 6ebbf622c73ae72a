"""Contents of `diagnosis.json` as pydantic models, and their check.

``python -m gyrostab.diagnose.result.content > docs/diagnosis.schema.json`` writes the JSON Schema.
Further keys are allowed anywhere.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from gyrostab.errors import SchemaError

Verdict = Literal["no mismatch", "explained", "partly explained", "unknown"]
View = Literal["davar", "mean", "cross_axis", "spectrum", "distribution", "restart"]
VERDICTS: tuple[str, ...] = get_args(Verdict)
SCHEMA = "gyrostab.diagnosis/1"


def _check_time(text: str) -> str:
    try:
        is_time = not np.isnat(np.datetime64(text.removesuffix("Z")))
    except ValueError:
        is_time = False
    if not is_time:
        raise ValueError("expected a time in ISO 8601")
    return text


_TIME_SCHEMA = {"type": "string", "format": "date-time", "pattern": "^[0-9]{4}"}
Time = Annotated[str, AfterValidator(_check_time), WithJsonSchema(_TIME_SCHEMA)]
Span = Annotated[list[Time], Field(min_length=2, max_length=2)]


NotNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class _Table(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)


class Recording(_Table):
    """What was recorded."""

    files: list[str]
    axes: list[str]
    start: Time
    end: Time
    sampling_rate_hz: Annotated[float, Field(gt=0.0)]
    channels: list[str]
    missing_share: Share


class NoiseEntry(_Table):
    """A noise coefficient of an axis; null: the record does not determine it."""

    value: float
    stderr: NotNegative | None
    unit: str


class Expected(_Table):
    """An effect of the model whose size was taken from the recording."""

    name: str
    axes: list[str]
    statement: str


class Baseline(_Table):
    """What the recording was compared with."""

    source: Literal["calibrated", "model", "simulation"]
    noise: dict[str, dict[Literal["Q", "N", "B", "K", "R"], NoiseEntry]]
    calibrated_on: list[Span]
    expected: list[Expected] = []


class Mismatch(_Table):
    """Where recording and simulation differ."""

    id: int
    view: View
    axes: list[str]
    start: Time
    end: Time
    tau_min_s: NotNegative | None
    tau_max_s: NotNegative | None
    ratio: float | None
    p_value: Share
    explained_by: list[str]
    statement: str


class Size(_Table):
    """A fitted parameter of an effect."""

    value: float | None
    stderr: NotNegative | None
    low: float | None
    high: float | None
    unit: str


class HeldOutGain(_Table):
    """Evidence of an effect: log Bayes factor [nats], on held-out data or the whole record."""

    nats: float
    stderr: NotNegative | None
    threshold: float


class NamedEffect(_Table):
    """An effect that explains mismatches."""

    name: str
    axes: list[str]
    driver: str | None
    intervals: list[Span]
    parameters: dict[str, Size]
    held_out_gain: HeldOutGain
    alternatives: list[str]
    probability: Share | None = None
    family: str | None = None
    statement: str


class NotFound(_Table):
    """An effect that was not seen."""

    upper_limit: float | None
    unit: str | None
    reason: str


class Rejected(_Table):
    """An effect that was examined and not named."""

    name: str
    axes: list[str]
    beaten_by: str
    nats: float | None


class UnusedChannel(_Table):
    """A channel that was not used."""

    name: str
    reason: str


class ChannelDelay(_Table):
    """A channel whose time stamps are late; below zero, early."""

    name: str
    delay_s: float


class HeldOut(_Table):
    """Evidence on held-out data."""

    blocks: Annotated[int, Field(ge=0)]
    log_likelihood_gain: float | None
    stderr: NotNegative | None
    misfit_before: NotNegative | None
    misfit_after: NotNegative | None
    coverage95_before: Share | None
    coverage95_after: Share | None
    forecast_gain: float | None


class Content(_Table):
    """Contents of `diagnosis.json`."""

    schema_: Annotated[Literal["gyrostab.diagnosis/1"], Field(alias="schema")]
    recording: Recording
    baseline: Baseline
    verdict: Verdict
    false_alarm_level: Share
    settings: dict[str, float] = {}
    mismatches: list[Mismatch]
    effects: list[NamedEffect]
    unexplained: list[int]
    not_found: dict[str, NotFound]
    rejected: list[Rejected] = []
    unused_channels: list[UnusedChannel] = []
    channel_delays: list[ChannelDelay] = []
    held_out: HeldOut
    seconds: NotNegative

    @model_validator(mode="after")
    def _check_references(self) -> Content:
        numbers = [region.id for region in self.mismatches]
        if len(set(numbers)) < len(numbers):
            raise ValueError(f"the ids of the mismatches are not unique: {numbers}")
        names = {effect.name for effect in self.effects}
        for place, region in enumerate(self.mismatches):
            if stray := [name for name in region.explained_by if name not in names]:
                raise ValueError(
                    f"mismatches[{place}].explained_by lists {stray[0]!r}, "
                    "which is not among the effects"
                )
        if unknown := [number for number in self.unexplained if number not in numbers]:
            raise ValueError(f"unexplained lists mismatch {unknown[0]}, which does not exist")
        return self


def check_diagnosis(content: Mapping[str, Any]) -> None:
    """Raise `SchemaError`, naming the place, unless `content` has the form of a `diagnosis.json`.

    Examples
    --------
    >>> check_diagnosis({"schema": "gyrostab.diagnosis/1"})
    Traceback (most recent call last):
    gyrostab.errors.SchemaError: diagnosis: recording is missing
    """
    try:
        Content.model_validate(content)
    except ValidationError as invalid:
        error = invalid.errors(include_url=False)[0]
        place = "".join(
            f"[{key}]" if isinstance(key, int) else f".{key}" for key in error["loc"]
        ).removeprefix(".")
        message = error["msg"].removeprefix("Value error, ")
        if error["type"] == "missing":
            message = f"{place} is missing"
        elif place:
            message = message.replace("Input should be", "expected")
            message = f"{place} is {error['input']!r}, {message}"
        raise SchemaError(f"diagnosis: {message}") from invalid


def make_schema() -> dict[str, Any]:
    """Make the JSON Schema of the file."""
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, **Content.model_json_schema()}


if __name__ == "__main__":
    print(json.dumps(make_schema(), indent=1))
