from .app import (
    Panel as Panel,
)
from .session import (
    carry_out_by_hand as carry_out_by_hand,
)
from .sources import (
    HandsOnRig as HandsOnRig,
    RunInProgress as RunInProgress,
)
