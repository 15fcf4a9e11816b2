"""Rig files that extend another: a packaged rig or a file beside."""

import json
from pathlib import Path

import pytest
from heater_laboratory import RIG

from bench.base import ConfigurationError
from bench.record import Record
from bench.rig import load_rig

TITLE = '[rig]\ntitle = "mine"\n'


@pytest.fixture
def folder(tmp_path):
    """Write rig files, by name, into one folder, and return it."""

    def write(**texts):
        for name, text in texts.items():
            (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
        return tmp_path

    return write


def refused(path, overrides=None):
    """Return the one line that says what is wrong with a rig file, which it names."""
    with pytest.raises(ConfigurationError) as caught:
        load_rig(str(path), overrides)
    message = str(caught.value)
    assert "\n" not in message, message
    assert caught.value.exit_code == 2
    return message


class TestMerging:
    def test_a_packaged_rig_with_other_values(self, folder):
        packaged = load_rig("vo2")
        mine = load_rig(str(folder(mine=f'extends = "vo2"\n{TITLE}[devices.tec]\naddress = 7\n') / "mine.toml"))
        assert mine.name == "mine"
        assert mine.rig.title == "mine"
        assert mine.rig.description == packaged.rig.description
        assert mine.content["devices"]["tec"] == {**packaged.content["devices"]["tec"], "address": 7}
        assert {key: mine.content[key] for key in packaged.content if key not in ("rig", "devices")} == {
            key: packaged.content[key] for key in packaged.content if key not in ("rig", "devices")
        }

    def test_a_file_beside_wherever_one_stands(self, folder, monkeypatch, tmp_path_factory):
        path = folder(heater=RIG, mine=f'extends = "heater.toml"\n{TITLE}') / "mine.toml"
        monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
        mine = load_rig(str(path))
        assert mine.rig.title == "mine"
        assert [device.name for device in mine.devices] == ["tec", "probe"]

    def test_one_over_another_over_a_third(self, folder):
        path = folder(
            heater=RIG,
            middle='extends = "heater.toml"\n[telemetry]\nperiod = 2.0\n[emulation]\nnoise = 0.5\n',
            mine='extends = "middle.toml"\n[emulation]\nnoise = 0.25\n',
        )
        mine = load_rig(str(path / "mine.toml"))
        assert mine.telemetry.period == 2.0
        assert mine.laboratory_settings.noise == 0.25

    def test_a_list_takes_the_place_of_the_other(self, folder):
        mine = 'extends = "heater.toml"\n[[interlocks]]\nsignal = "tec_temperature"\nhigh = 50.0\n'
        interlocks = load_rig(str(folder(heater=RIG, mine=mine) / "mine.toml")).interlocks
        assert [(each.signal, each.high) for each in interlocks] == [("tec_temperature", 50.0)]

    def test_keys_left_out(self, folder):
        mine = 'extends = "heater.toml"\nwithout = ["interlocks", "emulation.noise", "telemetry"]\n'
        rig = load_rig(str(folder(heater=RIG, mine=mine) / "mine.toml"))
        assert rig.interlocks == ()
        assert rig.telemetry.period == 1.0
        assert rig.emulated
        assert rig.content["emulation"] == {"laboratory": "heater_laboratory:HeaterLaboratory"}

    def test_overrides_replace_what_the_other_says(self, folder):
        path = str(folder(mine=f'extends = "vo2"\n{TITLE}') / "mine.toml")
        rig = load_rig(path, {"devices.tec.address": "9", "rig.title": "theirs"})
        assert rig.content["devices"]["tec"]["address"] == 9
        assert rig.rig.title == "theirs"
        assert "fan" in refused(path, {"devices.fan.port": "x"})


class TestWrong:
    def test_unknown_base(self, folder):
        message = refused(folder(mine='extends = "vo3"\n') / "mine.toml")
        assert "'vo3'" in message
        assert "did you mean vo2" in message

    def test_no_file_beside(self, folder):
        assert "other.toml cannot be read" in refused(folder(mine='extends = "other.toml"\n') / "mine.toml")

    @pytest.mark.parametrize("line", ["extends = 3", 'extends = ["vo2"]', 'extends = "vo2"\nwithout = "emulation"'])
    def test_wrong_types(self, folder, line):
        message = refused(folder(mine=f"{line}\n{TITLE}") / "mine.toml")
        assert "mine.toml: extends = " in message
        assert "expected the name of a rig" in message

    def test_nothing_to_leave_keys_out_of(self, folder):
        assert "extends = None, without = ['emulation']" in refused(
            folder(mine=f'without = ["emulation"]\n{TITLE}') / "mine.toml"
        )

    @pytest.mark.parametrize("key", ["emulated", "emulation.noises", "devices.tec.port.deeper", "devices.fan.port"])
    def test_leaves_out_what_is_not_there(self, folder, key):
        path = folder(heater=RIG, mine=f'extends = "heater.toml"\nwithout = ["{key}"]\n')
        message = refused(path / "mine.toml")
        assert "mine.toml: without = " in message
        assert repr(key) in message
        assert "heater.toml has no such key" in message

    def test_a_circle(self, folder):
        path = folder(a='extends = "b.toml"\n', b='extends = "./a.toml"\n', self='extends = "self.toml"\n')
        assert "b.toml: extends = './a.toml': the rigs extend each other in a circle" in refused(path / "a.toml")
        assert "self.toml: extends = 'self.toml'" in refused(path / "self.toml")

    def test_what_the_other_lacks_is_said_of_the_file(self, folder):
        message = refused(folder(heater=RIG, mine='extends = "heater.toml"\n[telemetry]\npace = 2.0\n') / "mine.toml")
        assert "mine.toml: telemetry.pace" in message

    def test_a_file_of_the_name_of_the_packaged_rig_that_it_extends(self, folder, monkeypatch):
        monkeypatch.chdir(folder(vo2=f'extends = "vo2"\n{TITLE}'))
        assert load_rig("vo2.toml").rig.title == "mine"


class TestThroughTheCommandLine:
    def test_a_copy_of_the_hardware_rig_loads(self, bench, tmp_path):
        code, text, _ = bench("show", "vo2-hardware")
        assert code == 0
        copy = tmp_path / "ours.toml"
        copy.write_text(text, encoding="utf-8")
        rig, emulated = load_rig(str(copy)), load_rig("vo2")
        assert rig.content == load_rig("vo2-hardware").content
        assert "emulation" not in rig.content
        assert not rig.emulated
        assert [device.name for device in rig.devices] == [device.name for device in emulated.devices]
        assert rig.content["devices"]["tec"] == {**emulated.content["devices"]["tec"], "port": "/dev/ttyUSB0"}
        assert rig.protocols == emulated.protocols

    def test_the_journal_keeps_the_merged_content(self, bench, tmp_path, folder):
        text = f'extends = "vo2"\n{TITLE}[telemetry]\nperiod = 1.5\n'
        path = folder(mine=text) / "mine.toml"
        result = tmp_path / "result.json"
        code, _, err = bench(
            *("run", "creep", "--rig", path, "--clock", "virtual", "--out", tmp_path, "--json", result),
            *("--set", "duration=4", "--set", "settling=2"),
            *("--override", "devices.psd.samples=5"),
        )
        assert code == 0, err
        with Record(Path(json.loads(result.read_text())["folder"])) as record:
            meta = record.meta
        assert meta["rig"] == "mine"
        assert meta["rig_file"] == text
        assert meta["rig_content"] == load_rig(str(path), {"devices.psd.samples": "5"}).content
        assert meta["rig_content"]["devices"]["psd"]["samples"] == 5
        assert meta["rig_content"]["telemetry"]["period"] == 1.5
