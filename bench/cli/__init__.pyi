from .application import (
    EXIT_CODES as EXIT_CODES,
    app as app,
    main as main,
)
from .catalogue import (
    installed as installed,
)
from .command_support import (
    STANDARD_OUTPUT as STANDARD_OUTPUT,
    JsonOption as JsonOption,
    parse_assignments as parse_assignments,
    parse_numbers as parse_numbers,
    write_json as write_json,
)
from .printing import (
    console as console,
    warn as warn,
)
