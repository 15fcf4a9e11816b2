from .context import (
    RECORDING_NAME as RECORDING_NAME,
    Run as Run,
)
from .engine import (
    check_before_moving as check_before_moving,
)
from .rehearsal import (
    Extremes as Extremes,
    Rehearsal as Rehearsal,
)
from .resumption.interrupted import (
    Resume as Resume,
)
from .resumption.repetition import (
    repeat as repeat,
)
from .resumption.resuming import (
    resume as resume,
)
from .run import (
    RunResult as RunResult,
    carry_out as carry_out,
    foresee as foresee,
)
from .terminal import (
    say_what_ctrl_c_does as say_what_ctrl_c_does,
)
