from .coverage import (
    Coverage as Coverage,
    swept_cells as swept_cells,
)
from .density import (
    Density as Density,
    density_unit as density_unit,
)
from .documents import (
    Model as Model,
    Parts as Parts,
)
from .dynamic.actuator_dynamics import (
    ActuatorDynamics as ActuatorDynamics,
    IdentifiedDynamics as IdentifiedDynamics,
    ResponseDynamics as ResponseDynamics,
    SeenInput as SeenInput,
)
from .dynamic.hammerstein import (
    Hammerstein as Hammerstein,
    HammersteinState as HammersteinState,
    velocities as velocities,
)
from .dynamic.linear_inverse import (
    bring_responses as bring_responses,
)
from .dynamic.linear_parts import (
    FilterState as FilterState,
    LinearPart as LinearPart,
    logarithmic_creep as logarithmic_creep,
    passages as passages,
    split_delay as split_delay,
)
from .dynamic.model_with_time import (
    TimedModel as TimedModel,
    TimedSequence as TimedSequence,
    check_sequence as check_sequence,
)
from .dynamic.oscillator import (
    BoucWenOscillator as BoucWenOscillator,
    Drive as Drive,
    Interpolation as Interpolation,
    OscillatorState as OscillatorState,
    Start as Start,
    respond as respond,
    substeps_for as substeps_for,
)
from .dynamic.preisach_oscillator import (
    PreisachOscillator as PreisachOscillator,
    PreisachOscillatorState as PreisachOscillatorState,
    demagnetised as demagnetised,
)
from .dynamic.rate_dependent_plays import (
    PlaysState as PlaysState,
    RateDependentPlays as RateDependentPlays,
)
from .inverses.branch_inverse import (
    BranchInverse as BranchInverse,
)
from .inverses.falling_inverse import (
    FallingInverse as FallingInverse,
)
from .inverses.inverse import (
    Inverse as Inverse,
    Inversion as Inversion,
    NumericalInverse as NumericalInverse,
    PlayInverse as PlayInverse,
    Policy as Policy,
    PreisachInverse as PreisachInverse,
    TableInverse as TableInverse,
)
from .kernels import (
    actuator_kernels as actuator_kernels,
    memory_kernels as memory_kernels,
)
from .kernels.memory_kernels import (
    borrowed as borrowed,
)
from .memory import (
    MemoryCurve as MemoryCurve,
    overwritten_from as overwritten_from,
)
from .operator import (
    Operator as Operator,
    Shape as Shape,
    operator_from_json as operator_from_json,
)
from .operators.bouc_wen import (
    BoucWen as BoucWen,
)
from .operators.duhem import (
    Duhem as Duhem,
)
from .operators.generalized_prandtl_ishlinskii import (
    Envelope as Envelope,
    GeneralizedPrandtlIshlinskii as GeneralizedPrandtlIshlinskii,
)
from .operators.krasnoselskii_pokrovskii import (
    KrasnoselskiiPokrovskii as KrasnoselskiiPokrovskii,
)
from .operators.maxwell_slip import (
    MaxwellSlip as MaxwellSlip,
)
from .operators.polynomial import (
    Polynomial as Polynomial,
)
from .operators.polynomial_plays import (
    PolynomialPlays as PolynomialPlays,
)
from .operators.prandtl_ishlinskii import (
    DeadZones as DeadZones,
    PlayState as PlayState,
    PrandtlIshlinskii as PrandtlIshlinskii,
)
from .operators.preisach import (
    Preisach as Preisach,
    uniform_levels as uniform_levels,
)
from .operators.reversible import (
    PolynomialTerm as PolynomialTerm,
    QuadraticTerm as QuadraticTerm,
    Reversible as Reversible,
    ThermalExpansion as ThermalExpansion,
    reversible_from_json as reversible_from_json,
)
from .operators.two_stage import (
    Coupled as Coupled,
    Linear as Linear,
    Stage as Stage,
    Summed as Summed,
    TwoStage as TwoStage,
)
from .reach import (
    Reach as Reach,
)
from .registered_models import (
    ModelSpec as ModelSpec,
    find_model as find_model,
    identifiable_models as identifiable_models,
    model_class as model_class,
    model_from_json as model_from_json,
    timed_models as timed_models,
)
from .regressor import (
    Regressor as Regressor,
)
from .streams.coupled_stream import (
    TwoStageState as TwoStageState,
    TwoStageStream as TwoStageStream,
)
from .streams.inverse_stream import (
    InverseStream as InverseStream,
)
from .streams.stream import (
    Stream as Stream,
)
from .transport import (
    transported as transported,
    widened as widened,
    widening as widening,
)
