from .desk import (
    SYNTAX as SYNTAX,
    Command as Command,
    Desk as Desk,
    HoldAll as HoldAll,
    Leave as Leave,
    Remark as Remark,
    Rest as Rest,
    SetPoint as SetPoint,
    Shown as Shown,
    Tare as Tare,
    parse_command as parse_command,
)
from .mailbox import (
    END as END,
    PAUSE as PAUSE,
    PanelMailbox as PanelMailbox,
    RunMailbox as RunMailbox,
)
from .questions import (
    ABORT as ABORT,
    AT_A_PAUSE as AT_A_PAUSE,
    AT_A_PROMPT as AT_A_PROMPT,
    MEANINGS as MEANINGS,
    NOBODY as NOBODY,
    NOTE as NOTE,
    OFF as OFF,
    RESUME as RESUME,
    SET as SET,
    STEP as STEP,
    Question as Question,
)
