from .attachment import (
    AttachedClock as AttachedClock,
    Attachment as Attachment,
    ControlClient as ControlClient,
    Endpoint as Endpoint,
    attach as attach,
    read_endpoints as read_endpoints,
)
from .calibration import (
    Calibration as Calibration,
    calibrate as calibrate,
)
from .connected import (
    Look as Look,
    Rig as Rig,
    clock_for as clock_for,
)
from .derived import (
    Derived as Derived,
    DerivedSignal as DerivedSignal,
    Expression as Expression,
)
from .description import (
    RigDescription as RigDescription,
)
from .fault_schedule import (
    ScheduledFault as ScheduledFault,
    read_schedule as read_schedule,
    schedule_faults as schedule_faults,
)
from .file import (
    DeviceEntry as DeviceEntry,
    LaboratorySettings as LaboratorySettings,
    RigFile as RigFile,
    RigTable as RigTable,
    SafetyTable as SafetyTable,
    TelemetryTable as TelemetryTable,
    load_rig as load_rig,
    packaged_rigs as packaged_rigs,
    rig_of_content as rig_of_content,
)
from .interlocks.config import (
    SETPOINT as SETPOINT,
    Interlock as Interlock,
    Level as Level,
)
from .interlocks.watch import (
    InterlockFinding as InterlockFinding,
    InterlockWatch as InterlockWatch,
)
from .layout import (
    DashboardLayout as DashboardLayout,
    Range as Range,
    XYPlot as XYPlot,
)
from .maintenance.check_up import (
    check_up as check_up,
)
from .maintenance.clearing import (
    Condition as Condition,
    clear_expired_watchdogs as clear_expired_watchdogs,
    look as look,
    recover as recover,
)
from .maintenance.locks import (
    ECHO as ECHO,
    EMULATED as EMULATED,
    JOIN as JOIN,
    Holder as Holder,
    Locks as Locks,
    is_in_use as is_in_use,
    is_own as is_own,
    line_names as line_names,
    port_of as port_of,
)
from .maintenance.opening import (
    opened as opened,
)
from .maintenance.rescue import (
    UNANSWERED as UNANSWERED,
    Rescued as Rescued,
    rescue as rescue,
)
from .maintenance.safe_state import (
    SAFE as SAFE,
    make_safe as make_safe,
    raise_if_unsafe as raise_if_unsafe,
)
from .rehearsal_rig import (
    twin_of as twin_of,
)
from .shared_lines import (
    BLIND as BLIND,
    LONGEST_TURN as LONGEST_TURN,
)
from .slots import (
    RoleTable as RoleTable,
    Slot as Slot,
    Slots as Slots,
    check_bound as check_bound,
    rate_unit as rate_unit,
)
from .start_checks import (
    LongestAbsence as LongestAbsence,
    calibration_warnings as calibration_warnings,
    check_start as check_start,
    lines_of as lines_of,
    longest_away as longest_away,
    shortened_absences as shortened_absences,
)
from .uncertainty import (
    LEVEL as LEVEL,
    OWN as OWN,
    Budget as Budget,
    BudgetRow as BudgetRow,
    Component as Component,
    Part as Part,
    UncertainReading as UncertainReading,
    UncertainSignals as UncertainSignals,
    coverage_factor as coverage_factor,
    effective_freedom as effective_freedom,
)
