from .approach import (
    Approach as Approach,
)
from .baselines import (
    saturation as saturation,
)
from .catalogue import (
    ControllerSetup as ControllerSetup,
    ControllerSpec as ControllerSpec,
    Fallback as Fallback,
    controller_names as controller_names,
    controller_spec as controller_spec,
    load_model_for as load_model_for,
    make_controller as make_controller,
    make_supervised as make_supervised,
    saturated_below as saturated_below,
    time_to_rest as time_to_rest,
)
from .convergence import (
    LimitCycleWatch as LimitCycleWatch,
)
from .estimators import (
    DisturbanceEstimator as DisturbanceEstimator,
    DriftEstimator as DriftEstimator,
    agility_for as agility_for,
)
from .following import (
    FollowingParameters as FollowingParameters,
)
from .loops import (
    SHORTEST_WAIT as SHORTEST_WAIT,
    BlockController as BlockController,
    ControlTask as ControlTask,
    DelayedController as DelayedController,
    Floats as Floats,
    FollowReference as FollowReference,
    Playback as Playback,
    ReachTarget as ReachTarget,
    SampledController as SampledController,
)
from .model_filters import (
    ADAPTATIONS as ADAPTATIONS,
    AdaptationName as AdaptationName,
)
from .references import (
    AddedSine as AddedSine,
    ApproachedReference as ApproachedReference,
    Reference as Reference,
    SmoothMoves as SmoothMoves,
    fastest_slope as fastest_slope,
    modulated_sine as modulated_sine,
    staircase as staircase,
    tracking_targets as tracking_targets,
)
from .supervision import (
    Rules as Rules,
    Supervised as Supervised,
    SupervisedFollower as SupervisedFollower,
)
from .tracking import (
    Command as Command,
    ControllerBase as ControllerBase,
    Trace as Trace,
    check_positive as check_positive,
    widened as widened,
)
from .tuning import (
    Spans as Spans,
    tuned as tuned,
)
from .tuning_file import (
    Tuning as Tuning,
    load_tuning as load_tuning,
    tuning_text as tuning_text,
)
