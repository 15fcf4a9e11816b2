from .devices import (
    ActuatorContract as ActuatorContract,
    DeviceContract as DeviceContract,
)
from .emulated import (
    OnEmulatedRig as OnEmulatedRig,
)
from .faults import (
    ActuatorLineLostContract as ActuatorLineLostContract,
    LineLostContract as LineLostContract,
    RestartedActuatorContract as RestartedActuatorContract,
    RestartedInstrumentContract as RestartedInstrumentContract,
    SafeOverAFreshLineContract as SafeOverAFreshLineContract,
    SilentInstrumentContract as SilentInstrumentContract,
    SpoiltAnswerContract as SpoiltAnswerContract,
    WatchdogContract as WatchdogContract,
)
from .operators import (
    OperatorContract as OperatorContract,
)
from .roles import (
    LinearStageContract as LinearStageContract,
    LoadCellContract as LoadCellContract,
    PositionSensorContract as PositionSensorContract,
    ServoContract as ServoContract,
    SwitchContract as SwitchContract,
    TECAmplifierContract as TECAmplifierContract,
    TemperatureSensorContract as TemperatureSensorContract,
    VoltageSupplyContract as VoltageSupplyContract,
)
