from .advice import (
    ONE_RUN as ONE_RUN,
    Advice as Advice,
    advise_on_record as advise_on_record,
    once as once,
)
from .bands import (
    Band as Band,
    calibrate_band as calibrate_band,
    calibrate_band_in_time as calibrate_band_in_time,
    input_half_widths as input_half_widths,
)
from .branches import (
    turning_points as turning_points,
)
from .by_name import (
    Candidate as Candidate,
    Identification as Identification,
    Initial as Initial,
    check_words as check_words,
    identify as identify,
    set_up_problem as set_up_problem,
)
from .choose.cross_validation import (
    CrossValidation as CrossValidation,
    cross_validate as cross_validate,
)
from .choose.rule import (
    Given as Given,
    Selection as Selection,
    choose as choose,
    compared_models as compared_models,
    select as select,
)
from .choose.score import (
    Measurements as Measurements,
    Score as Score,
    evaluate as evaluate,
)
from .choose.splits import (
    record_of as record_of,
)
from .design.continuation import (
    Continuation as Continuation,
    continue_design as continue_design,
)
from .design.excitation import (
    damped_oscillation as damped_oscillation,
    ramps as ramps,
    random_validation as random_validation,
)
from .design.information import (
    NOISE as NOISE,
)
from .design.sequences import (
    Assessment as Assessment,
    assess as assess,
    covering_sequence as covering_sequence,
    first_order_reversals as first_order_reversals,
)
from .fit.covariance import (
    CoefficientUncertainties as CoefficientUncertainties,
    coefficient_uncertainties as coefficient_uncertainties,
)
from .fit.least_squares import (
    Certificate as Certificate,
    Fit as Fit,
    fit as fit,
    fit_minimum_norm as fit_minimum_norm,
    one_thread as one_thread,
)
from .fit.orientation import (
    Orientation as Orientation,
)
from .fit.regularization import (
    SMOOTHING as SMOOTHING,
    Regularization as Regularization,
    choose_regularization as choose_regularization,
)
from .fit.resolution import (
    Resolution as Resolution,
    resolve as resolve,
)
from .fit.two_stage_fit import (
    CoupledIdentification as CoupledIdentification,
    FirstStage as FirstStage,
    Series as Series,
    identify_first_stage as identify_first_stage,
    identify_linear as identify_linear,
    identify_second_stage as identify_second_stage,
    identify_summed as identify_summed,
    measure_series as measure_series,
    predict_series as predict_series,
    voltage_steps as voltage_steps,
)
from .fit.variable_projection import (
    Evidence as Evidence,
    Separable as Separable,
    Stage as Stage,
    variable_projection as variable_projection,
)
from .inspection import (
    check_data as check_data,
)
from .measures import (
    Comparison as Comparison,
    Errors as Errors,
    autocorrelation as autocorrelation,
    measure_errors as measure_errors,
)
from .memory_tests import (
    MemoryTest as MemoryTest,
    check_congruency as check_congruency,
    check_return_points as check_return_points,
)
from .model_file import (
    ModelFile as ModelFile,
    is_model as is_model,
    load_model as load_model,
    models_among as models_among,
    parse_model as parse_model,
)
from .options import (
    check_options as check_options,
    model_options as model_options,
    template_of as template_of,
)
from .recalibration import (
    Kind as Kind,
    Recalibration as Recalibration,
    parse_kinds as parse_kinds,
    recalibrate as recalibrate,
)
from .resonance import (
    DynamicsIdentification as DynamicsIdentification,
    ThirdOrder as ThirdOrder,
    identify_dynamics as identify_dynamics,
)
from .timed.identify_in_time import (
    identify_in_time as identify_in_time,
)
from .validity import (
    Beyond as Beyond,
    Validity as Validity,
)
