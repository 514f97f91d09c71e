"""The schema of a result file: what stands under which key, in SI and with every digit."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

FORMAT = "rpim-opt result"
VERSION = 1
Vector = list[float]
Matrix = list[Vector]
Cube = list[Matrix]
Term = str | list[Any] | None
"""A ready function by its name, or by that of its maker and the arguments; None for one that only a script has."""


class Part(BaseModel):
    """What all parts share: no key is converted, none may be infinite."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)


class GravityPart(Part):
    """Where gravity points and what it pulls at, as `Gravity` has it."""

    direction: Vector
    masses: Vector
    centres: Matrix
    payload: float
    payload_centre: Vector


class TermPart(Part):
    """A term of a user's own, whose function only a script has: where it acts, its parameters and columns."""

    at: str
    parameters: list[str]
    columns: dict[str, str]


class RobotPart(Part):
    """The nominal robot."""

    name: str
    source: str
    mdh: Matrix
    joint_types: list[str]
    joint_map: Matrix
    limits: list[Annotated[list[float | None], Field(min_length=2, max_length=2)]]
    gravity: GravityPart | None = None
    terms: list[TermPart] = Field(default_factory=list)


class ParameterPart(Part):
    """One model parameter; no tolerance is an infinite one."""

    name: str
    dimension: str
    nominal: float
    scale: float
    tolerance: float | None
    identified: bool


class BlockPart(Part):
    """Rows of one kind of measurement."""

    measurement: str
    markers: list[str]
    fixture: str
    row: list[int]
    q: Cube
    y: Matrix
    covariance: Cube
    torque: Cube | None
    payload: Vector | None = None
    approach: Cube | None = None
    columns: dict[str, Vector] = Field(default_factory=dict)
    robot: str = ""
    point: list[list[str]] | None = None
    session: list[str] | None = None


class DataPart(Part):
    """Measurements: labels, configurations and blocks."""

    label: list[str]
    configuration: list[int]
    blocks: list[BlockPart]


class SetsPart(Part):
    """Both sets of measurements."""

    identification: DataPart
    validation: DataPart | None = None


class SelectionPart(Part):
    """How the weight was chosen."""

    weight: float
    name: str
    weights: Vector
    score: list[float | None]
    interior: bool
    note: str
    groups: dict[str, float] = Field(default_factory=dict)


class QuadraticPart(Part):
    """A quadratic |L v - c|^2 + constant: L by its diagonal, or whole."""

    diagonal: Vector | None
    matrix: Matrix | None
    c: Vector
    constant: float


class FormsPart(Part):
    """The quadratics that a script's loss (of the residual) and penalty (of z) are."""

    loss: QuadraticPart | None
    penalty: QuadraticPart | None


class DefinitionPart(Part):
    """What the formulation is."""

    loss: Term
    penalty: Term
    constraints: list[Term]
    loss_over: str
    penalty_over: Term
    largest: float | None


class PassPart(Part):
    """One pass of the loop."""

    objective: float
    step: float
    weight: float
    damping: float = 0.0


class TrustPart(Part):
    """What a loss of a script made of the equations: a factor, and those that it left out."""

    factor: float
    left_out: list[int]


class CertificatePart(Part):
    """How well the conditions of a solution are met."""

    gradient: float | None
    step: float | None
    violation: float | None
    decrease: float | None = None


class HeldPart(Part):
    """A parameter at its bound."""

    name: str
    bound: float
    multiplier: float
    gain: float


class PricePart(Part):
    """What a statement of a drawing costs, in its unit."""

    text: str
    unit: str
    slack: float
    multiplier: float
    step: float
    gain: float
    misfit: float


class RequirementPart(Part):
    """What the robot is accepted by."""

    limit: float
    box: Annotated[list[Annotated[Vector, Field(min_length=2, max_length=2)]], Field(min_length=3, max_length=3)] | None
    joints: dict[str, Annotated[Vector, Field(min_length=2, max_length=2)]]
    marker: str
    confidence: float


class HeldOutPart(Part):
    """Rows that were kept apart and judged before they were used."""

    label: list[str]
    used: int
    nominal: list[float | None]
    error: list[float | None]
    sigmas: list[float | None]
    allowed: list[float | None]
    coverage: float | None


class EarlierPart(Part):
    """A calibration that this one carries on."""

    title: str
    made: str
    digest: str
    rows: int
    ranges: dict[str, list[list[float]]] = Field(default_factory=dict)
    inflate: float
    let_go: list[str]
    left_out: list[str]


class RecordPart(Part):
    """Where the measurements come from."""

    source: str
    files: dict[str, str]
    excluded: dict[str, str]
    simulated: bool
    made: str
    versions: dict[str, str]
    details: dict[str, str] = Field(default_factory=dict)
    requirement: RequirementPart | None = None
    held_out: HeldOutPart | None = None
    earlier: list[EarlierPart] = Field(default_factory=list)


class RowPart(Part):
    """The errors of one row."""

    label: str
    nominal_mm: float | None
    identified_mm: float | None


class SizePart(Part):
    """A size, and the standard deviation of its logarithm."""

    value: float
    spread: float


class TrialPart(Part):
    """Families of a model, and -2 ln of their likelihood."""

    families: list[str]
    value: float


class LeftOutPart(Part):
    """A row that was left out, and its error over the median."""

    label: str
    ratio: float


class LearnedPart(Part):
    """What was learned before the last fit."""

    sizes: dict[str, SizePart]
    noise: dict[str, SizePart]
    local: Vector
    trials: list[TrialPart]
    value: float
    freedom: float
    left_out: list[LeftOutPart]
    covariance: Matrix
    stated: Vector
    drift: Matrix
    added: list[str]
    notes: list[str] = Field(default_factory=list)


class ScatterPart(Part):
    """The robot's own noise."""

    position: float
    orientation: float
    joint: float
    instrument: float
    at: Vector | None


class File(Part):
    """A result file; what it holds besides follows from this."""

    format: Literal["rpim-opt result"]
    version: Literal[1]
    title: str
    formulation: str
    definition: DefinitionPart
    forms: FormsPart | None = None
    weight: float
    selection: SelectionPart | None
    converged: bool
    message: str
    history: list[PassPart]
    x: Vector
    certificate: CertificatePart | None
    trust: TrustPart | None
    held: list[HeldPart]
    robot: RobotPart | None = None
    robots: dict[str, RobotPart] = Field(default_factory=dict)
    prices: list[PricePart] = Field(default_factory=list)
    model: list[ParameterPart]
    data: SetsPart
    record: RecordPart
    rows: dict[str, list[RowPart]]
    scatter: ScatterPart | None = None
    learned: LearnedPart | None = None
    digest: str
