"""LabJack T7 over Modbus TCP: sensors of position and temperature, a switch, and a piezo's high-voltage supply."""

from drivers.labjack_t7.high_voltage import T7HighVoltageSupply
from drivers.labjack_t7.position import T7PositionSensor
from drivers.labjack_t7.switch import T7Switch
from drivers.labjack_t7.thermistor import T7Thermistor

__all__ = ["T7HighVoltageSupply", "T7PositionSensor", "T7Switch", "T7Thermistor"]
