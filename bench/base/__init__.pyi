from . import (
    checks as checks,
    errors as errors,
    registry as registry,
)
from .checked_table import (
    CheckedTable as CheckedTable,
)
from .checks import (
    Floats as Floats,
)
from .clock import (
    BUSY as BUSY,
    Clock as Clock,
    Pace as Pace,
    PacedClock as PacedClock,
    ScaledClock as ScaledClock,
    Stopwatch as Stopwatch,
    VirtualClock as VirtualClock,
    WallClock as WallClock,
    make_clock as make_clock,
    slowness as slowness,
    wall_time as wall_time,
)
from .compilation_display import (
    CompilationDisplay as CompilationDisplay,
    compile_kernels as compile_kernels,
)
from .compiled import (
    Cube as Cube,
    Fixed as Fixed,
    IntegerTable as IntegerTable,
    Table as Table,
    inlined as inlined,
    inner as inner,
    kernel as kernel,
    kernels_of as kernels_of,
    reordered as reordered,
)
from .configuration_errors import (
    explain as explain,
    problems as problems,
)
from .crc import (
    crc16_dynamixel as crc16_dynamixel,
    crc16_modbus as crc16_modbus,
)
from .deferred import (
    DeferredModule as DeferredModule,
)
from .errors import (
    AbortError as AbortError,
    AgreementError as AgreementError,
    BenchError as BenchError,
    ConfigurationError as ConfigurationError,
    ConvergenceError as ConvergenceError,
    DataError as DataError,
    DeviceConnectionError as DeviceConnectionError,
    DeviceError as DeviceError,
    DeviceRestartedError as DeviceRestartedError,
    GuardianError as GuardianError,
    IncompleteRecordWarning as IncompleteRecordWarning,
    InterlockError as InterlockError,
    LimitError as LimitError,
    RecordError as RecordError,
    SettleTimeoutError as SettleTimeoutError,
    WatchdogError as WatchdogError,
)
from .extras import (
    Extra as Extra,
    MissingExtraError as MissingExtraError,
    check_extra as check_extra,
    how_to_install as how_to_install,
    needed_for as needed_for,
)
from .interrupts import (
    ENDING as ENDING,
    STACKS as STACKS,
    Interrupts as Interrupts,
    say_at_once as say_at_once,
)
from .names import (
    closest as closest,
    counted as counted,
    reason as reason,
)
from .parsing import (
    comma_remark as comma_remark,
    end_of_json as end_of_json,
    json_text as json_text,
    parse_json as parse_json,
    parse_toml as parse_toml,
    toml_value as toml_value,
    write_json_file as write_json_file,
)
from .patience import (
    PatienceDisplay as PatienceDisplay,
    say_share as say_share,
    shares_to as shares_to,
    show_patience as show_patience,
)
from .printing import (
    PlainConsole as PlainConsole,
    aligned as aligned,
    html_table as html_table,
    print_plain as print_plain,
    print_table as print_table,
    show_rows as show_rows,
    show_table as show_table,
)
from .redaction import (
    OPTION as OPTION,
    redacted as redacted,
    redacted_command as redacted_command,
)
from .remaining_time import (
    Expectation as Expectation,
    Remaining as Remaining,
    RemainingTime as RemainingTime,
)
from .units import (
    Display as Display,
    check_unit as check_unit,
    difference_unit as difference_unit,
    fitting_prefix as fitting_prefix,
    format_duration as format_duration,
    format_numbers as format_numbers,
    header_with_unit as header_with_unit,
    in_si as in_si,
    in_unit as in_unit,
    is_quantity as is_quantity,
    per_square as per_square,
    percent as percent,
    prefixed as prefixed,
    quantity as quantity,
    read_quantity as read_quantity,
    significant as significant,
    unit_registry as unit_registry,
    with_unit as with_unit,
)
from .whole_files import (
    result_file as result_file,
    whole_file as whole_file,
    write_result as write_result,
    write_whole as write_whole,
)
from .workers.display import (
    TasksDisplay as TasksDisplay,
)
from .workers.pool import (
    Pending as Pending,
    Workers as Workers,
    available_cores as available_cores,
)
from .workers.task import (
    report as report,
    task_console as task_console,
)
