from .changes import (
    PARAMETER as PARAMETER,
    ParameterChange as ParameterChange,
)
from .discovery import (
    Packaged as Packaged,
    digest_of as digest_of,
    find_protocol as find_protocol,
    is_installed as is_installed,
    packaged_protocols as packaged_protocols,
    source_of as source_of,
)
from .fitting_rig import (
    fits as fits,
)
from .number_list import (
    NumberList as NumberList,
)
from .parameters import (
    OpenParameters as OpenParameters,
    ParameterHelp as ParameterHelp,
    ProtocolDefinition as ProtocolDefinition,
    ProtocolParameters as ProtocolParameters,
    difference_of as difference_of,
    from_slot as from_slot,
    parameter as parameter,
    protocol as protocol,
    unit_of as unit_of,
)
from .planning import (
    EXPECTED as EXPECTED,
    LONGEST as LONGEST,
    Plan as Plan,
    plan as plan,
)
from .views import (
    Views as Views,
)
from .vocabulary import (
    LATENESS as LATENESS,
    PROMPT as PROMPT,
    TRACES as TRACES,
    Arrived as Arrived,
    ByHand as ByHand,
    Caution as Caution,
    Control as Control,
    Dwell as Dwell,
    FixedRate as FixedRate,
    KeptModel as KeptModel,
    Message as Message,
    Messages as Messages,
    Note as Note,
    Phase as Phase,
    Prompt as Prompt,
    Reading as Reading,
    Settle as Settle,
    Settled as Settled,
    Slot as Slot,
    Slots as Slots,
    Step as Step,
    Summary as Summary,
    UntilSteady as UntilSteady,
)
