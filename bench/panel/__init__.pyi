from .app import (
    Panel as Panel,
)
from .sources import (
    HandsOnRig as HandsOnRig,
    RunInProgress as RunInProgress,
    carry_out_by_hand as carry_out_by_hand,
)
