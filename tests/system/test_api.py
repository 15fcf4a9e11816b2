"""What `import bench` offers: its examples, executed, and what it does when something goes wrong."""

import doctest
import re
import subprocess
import sys

import numpy as np
import pandas
import pytest

import bench
import bench.api
from bench.base import ConfigurationError, DataError, InterlockError
from bench.identification import ModelFile


@pytest.mark.parametrize("name", ["", "run", "identify", "deploy"])
def test_examples(name, request, tmp_path):
    tested = getattr(bench.api, name) if name else bench.api
    names = {**vars(bench.api), "getfixture": request.getfixturevalue, "bench": bench}
    finder = doctest.DocTestFinder(recurse=False)
    examples = finder.find(tested, name or "bench.api", module=bench.api, globs=names)
    results = [doctest.DocTestRunner().run(example) for example in examples]
    assert sum(result.attempted for result in results) > 1
    assert not sum(result.failed for result in results)


def test_importing_it_imports_nothing_heavy():
    code = "import sys, bench; dir(bench); print(sorted({'numpy', 'rerun', 'pydantic'} & set(sys.modules)))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


def test_what_it_does_not_offer():
    with pytest.raises(AttributeError, match="module 'bench' has no attribute 'runn'"):
        _ = bench.runn


def test_leaving_a_rig_makes_its_devices_safe_also_by_an_error():
    rig = bench.open_rig("vo2")
    emulated = rig.laboratory.tec

    def heat_and_fail():
        with rig:
            rig.devices["tec"].set(60.0)
            rig.clock.sleep(2.0)
            assert rig.devices["tec"].output_enabled
            _ = 1 / 0

    with pytest.raises(ZeroDivisionError):
        heat_and_fail()
    assert not emulated.output_enabled


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return bench.run("creep", "vo2", out=tmp_path_factory.mktemp("runs"), hot=60.0, cool=40.0, duration=8.0)


def test_a_run_is_tables_with_units(found):
    readings = found.readings
    assert readings.units["curvature"] == "1/m"
    text = repr(readings)
    assert "curvature [1/m]" in text
    assert "35 rows" in text
    assert "creep on vo2: completed, 35 readings" in repr(found)
    assert len(found.notes) == 2
    assert bench.load(str(found.folder)).status == "completed"


def test_tables_become_pandas_frames_where_pandas_is_installed(found, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ConfigurationError, match="pandas is not installed"):
        found.readings.to_pandas()
    monkeypatch.undo()
    frame = found.telemetry.to_pandas()
    assert frame["tec_temperature"].tolist() == found.telemetry["tec_temperature"].tolist()
    assert frame.attrs["units"]["tec_temperature"] == "°C"


def test_a_model_is_saved_loaded_and_reported(found, tmp_path, capsys):
    model = bench.identify(found, "polynomial", degree=2)
    assert re.search(r"polynomial: \w+ fit: .*\n +samples +35 ", repr(model))
    model.file.save(tmp_path / "model.json")
    loaded = bench.load(tmp_path / "model.json")
    assert isinstance(loaded, ModelFile)
    assert bench.predict(loaded, [40.0]) == bench.predict(tmp_path / "model.json", [40.0])
    assert bench.report(found, [model])["status"] == "completed"
    assert "polynomial" in capsys.readouterr().out


def test_a_table_in_memory_is_identified_as_the_same_in_a_file(tmp_path):
    time = np.arange(60) * 0.5
    inputs = np.sin(time)
    columns = {"time [s]": time, "U [V]": inputs, "x [mm]": inputs**3}
    frame = pandas.DataFrame(columns)
    frame.to_csv(tmp_path / "table.csv", index=False)
    sources = (tmp_path / "table.csv", frame, columns)
    models = [bench.identify(each, "polynomial,polynomial-plays", input="U", output="x") for each in sources]
    outputs = [bench.predict(model, inputs, times=time) for model in models]
    np.testing.assert_allclose(outputs[1:], [outputs[0], outputs[0]], rtol=1e-12)
    assert {(model.data.input.unit, model.data.output.unit) for model in models} == {("V", "mm")}
    with pytest.raises(DataError, match="row 3, column x"):
        bench.identify({"U": [1.0, 2.0, 3.0], "x": [1.0, 2.0, np.nan]}, "polynomial", input="U", output="x")


def test_of_several_files_each_is_left_out_once(tmp_path):
    paths = [tmp_path / f"{name}.csv" for name in "abc"]
    for phase, path in enumerate(paths):
        inputs = np.sin(np.linspace(phase, 20.0, 60))
        path.write_text("u,y\n" + "".join(f"{u},{u**3}\n" for u in inputs))
    found = bench.identify(paths, "polynomial,polynomial-plays", input="u", output="y")
    assert found.data.inputs.size == 180
    assert found.data.starts == (0, 60, 120)


@pytest.mark.parametrize("model", [None, "polynomial,polynomial-plays"])
def test_of_several_models_the_same_is_chosen_as_by_the_command(request, tmp_path, model):
    inputs = np.sin(np.linspace(0.0, 30.0, 60)) * np.linspace(1.0, 0.3, 60)
    table = tmp_path / "table.csv"
    table.write_text("t,u,y\n" + "".join(f"{-n},{u},{u**3}\n" for n, u in enumerate(inputs)))
    found = bench.identify(table, model, input="u", output="y", smoothing=0.01)
    assert "t does not increase in row 2" in found.data.assumptions
    request.getfixturevalue("bench")(
        "identify", table, "--input", "u", "--output", "y", "--smoothing", "0.01", "--out", tmp_path / "model.json",
        *([] if model is None else ["--model", model]),
    )  # fmt: skip
    chosen = bench.load(tmp_path / "model.json")
    assert (found.file.name, len(found.file.provenance["selection"]["table"])) == (
        chosen.name, len(chosen.provenance["selection"]["table"]),
    )  # fmt: skip
    np.testing.assert_array_equal(bench.predict(found, inputs), bench.predict(chosen, inputs))
    with pytest.raises(ConfigurationError, match="one model"):
        bench.identify(table, model, input="u", output="y", cross_validated=True)


def test_a_run_that_fails_raises_and_names_its_record(tmp_path):
    with pytest.raises(InterlockError) as caught:
        bench.run("creep", "vo2", out=tmp_path, overrides={"interlocks": '[{signal = "curvature", high = 1.0}]'})
    folder = next(tmp_path.iterdir())
    assert any(str(folder) in note for note in caught.value.__notes__)
    assert bench.load(folder).status == "failed"


def test_wrong_names_and_values(tmp_path, found):
    with pytest.raises(ConfigurationError, match="there is no protocol 'crep'"):
        bench.run("crep", "vo2", out=tmp_path)
    with pytest.raises(ConfigurationError, match="there is no parameter 'warm'"):
        bench.run("creep", "vo2", out=tmp_path, warm=3.0)
    with pytest.raises(ConfigurationError, match="there is no model 'preisatch'"):
        bench.identify(found, "preisatch")
    with pytest.raises(ConfigurationError, match=r"its columns are: U \[V\], x"):
        bench.identify({"U [V]": [1.0, 2.0], "x": [1.0, 2.0]}, "preisach", output="x")
    with pytest.raises(ConfigurationError, match="is empty"):
        bench.identify([], "preisach")
    with pytest.raises(DataError, match="is not a run"):
        bench.load(tmp_path)
