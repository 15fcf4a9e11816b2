"""A desk of eight emulated instruments, two TEC controllers and two T7s among them."""

from pathlib import Path

from bench.rig import load_rig
from sim_devices.laboratory import EmulatedLaboratory


class DeskLaboratory(EmulatedLaboratory):
    def __init__(self, settings, clock, seed):  # noqa: ARG002
        def made(rig):
            file = load_rig(rig)
            return file.laboratory(file.laboratory_settings, clock, seed)

        self.parts = {
            "a": made("vo2"),
            "b": made("vo2"),
            "muscle": made("sma"),
            "text": made(str(Path(__file__).parents[3] / "examples/bench-supply.toml")),
        }
        self.parts["b"].tec.serial_number += 1
        self.parts["a"].t7.serial_number += 1
        wanted = {
            "tec_a": ("a", "tec"), "tec_b": ("b", "tec"), "t7_a": ("a", "psd"), "t7_b": ("muscle", "t7"),
            "supply": ("muscle", "supply"), "load_cell": ("muscle", "load_cell"), "stage": ("muscle", "stage"),
            "heater": ("text", "supply"),
        }  # fmt: skip
        servers = {name: self.parts[part].servers[server] for name, (part, server) in wanted.items()}
        super().__init__("desk", servers, clock, seed=seed)

    def truth(self):
        return {f"{name}_{key}": value for name, part in self.parts.items() for key, value in part.truth().items()}
