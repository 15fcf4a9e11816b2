import copy
import json
import math
from itertools import product

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.base import DataError
from bench.identification import ModelFile, load_model, parse_model
from bench.identification.model_file import FORMAT, VERSION
from bench.models import (
    Linear,
    MemoryCurve,
    Polynomial,
    PrandtlIshlinskii,
    Preisach,
    QuadraticTerm,
    Summed,
    ThermalExpansion,
    TwoStage,
    uniform_levels,
)
from rigs.hybrid.design import Design
from rigs.hybrid.model import PUBLISHED_DYNAMICS, HybridModel

LEVELS = uniform_levels(30.0, 70.0, 4)
INPUTS = np.array([21.0, 84.0, 40.0, 60.0, 55.0])


def preisach(term=None):
    density = np.linspace(0.1, 1.0, 10)
    return Preisach(LEVELS, density, 3.5, term, (21.0, 84.0), "°C", "1/m")


MODELS = {
    "preisach": preisach(),
    "non-monotonic": preisach(ThermalExpansion(2.8, 4.3, 30.0, 70.0, 20.0)),
    "with a quadratic": preisach(QuadraticTerm(0.5, -0.01, 20.0)),
    "with a line": preisach(QuadraticTerm(0.5)),
    "polynomial": Polynomial([1.0, -2.0, 0.5], (21.0, 84.0), 7.0, "°C", "1/m"),
}
MEMORY = MemoryCurve((84.0, 40.0, 60.0), 55.0)


def content(name="non-monotonic"):
    memory = None if name == "polynomial" else MEMORY
    file = ModelFile(name, MODELS[name], memory, {"source": "data.csv", "rows": 3400})
    return json.loads(json.dumps(file.to_json()))


def changed(document, path, value):
    """Return a document whose value at a path is another."""
    document = copy.deepcopy(document)
    *parents, key = path
    node = document
    for part in parents:
        node = node[part]
    node[key] = value
    return document


class TestRoundTrip:
    @cases("name", list(MODELS))
    def test_every_operator(self, tmp_path, name):
        path = tmp_path / "model.json"
        memory = None if name == "polynomial" else MEMORY
        ModelFile(name, MODELS[name], memory, {"source": "µ.csv", "rms": 0.1 + 0.2}).save(path)
        loaded = load_model(path)
        assert loaded.name == name
        assert loaded.memory == memory
        assert loaded.provenance["source"] == "µ.csv"
        assert loaded.provenance["rms"] == 0.1 + 0.2
        assert loaded.provenance["bench"]
        assert loaded.operator.input_unit == "°C"
        assert loaded.operator.output_unit == "1/m"
        assert loaded.operator.input_range == MODELS[name].input_range
        np.testing.assert_array_equal(loaded.operator.evaluate(INPUTS), MODELS[name].evaluate(INPUTS))
        assert loaded.to_json() == json.loads(path.read_text(encoding="utf-8"))

    def test_saving_twice_gives_the_same_file(self, tmp_path):
        for name in ("a.json", "b.json"):
            ModelFile("m", MODELS["preisach"], MEMORY).save(tmp_path / name)
        assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
        load_model(tmp_path / "a.json").save(tmp_path / "c.json")
        assert (tmp_path / "c.json").read_bytes() == (tmp_path / "a.json").read_bytes()

    def test_saving_where_it_cannot(self, tmp_path):
        with pytest.raises(DataError, match="cannot be written"):
            ModelFile("m", MODELS["preisach"], None).save(tmp_path / "absent" / "m.json")


class TestUnusable:
    def test_a_run_is_refused_with_the_model_that_is_kept_with_it(self, tmp_path):
        kept = tmp_path / "models" / "m.json"
        kept.parent.mkdir()
        ModelFile("m", MODELS["preisach"], None).save(kept)
        with pytest.raises(DataError) as caught:
            load_model(tmp_path)
        assert str(kept) in str(caught.value)

    def test_no_file(self, tmp_path):
        with pytest.raises(DataError, match=r"absent\.json cannot be read: No such file"):
            load_model(tmp_path / "absent.json")
        with pytest.raises(DataError, match="cannot be read"):
            load_model(tmp_path)

    @cases(
        "text",
        [b"", b"\xff\xfe", b"[1, 2", b'{"format": "bench-model", "version": 1' + b"0" * 5000 + b"}", b"[" * 100_000],
    )
    def test_no_json(self, tmp_path, text):
        path = tmp_path / "m.json"
        path.write_bytes(text)
        with pytest.raises(DataError, match=r"m\.json"):
            load_model(path)

    @cases("document", [None, [], "x", 5, {}, {"format": "other"}])
    def test_no_model_file(self, document):
        with pytest.raises(DataError, match=rf"m\.json is not a model file: its `format` is not '{FORMAT}'"):
            parse_model(document, "m.json")

    @cases("version", [0, 1, 3, "2", None, [2]])
    def test_another_version(self, version):
        with pytest.raises(DataError, match=f"has version .*; this bench reads version {VERSION}"):
            parse_model({**content(), "version": version}, "m.json")

    def test_an_unknown_key_and_a_name_that_is_no_text_are_refused(self):
        document = content()
        for wrong in ({"extra": 1}, {"name": math.nan}, {"model": {**document["model"], "extra": 1}}):
            with pytest.raises(DataError, match=r"m\.json"):
                parse_model({**document, **wrong}, "m.json")

    @cases("key", ["name", "kind", "model", "memory", "provenance"])
    def test_a_missing_key_is_named(self, key):
        document = content()
        del document[key]
        with pytest.raises(DataError, match=rf"m\.json is damaged: key '{key}' is missing"):
            parse_model(document, "m.json")


def _paths(node, prefix=()):
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        yield (*prefix, key)
        if isinstance(value, dict | list):
            yield from _paths(value, (*prefix, key))


values = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.floats(),
        st.text(max_size=6),
        st.sampled_from([10**400, -1, 0, 1e308]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=4), inner, max_size=2)),
    max_leaves=4,
)


@settings(max_examples=200, deadline=None)
@given(name=st.sampled_from(list(MODELS)), data=st.data())
def test_any_mutation_is_a_usable_model_or_a_data_error(name, data):
    document = copy.deepcopy(content(name))
    for _ in range(data.draw(st.integers(1, 3))):
        known = list(_paths(document))
        if not known:
            break
        *parents, key = data.draw(st.sampled_from(known))
        node = document
        for part in parents:
            node = node[part]
        action = data.draw(st.sampled_from(["replace", "replace", "delete", "add"]))
        if action == "replace":
            node[key] = data.draw(values)
        elif action == "delete":
            del node[key]
        elif isinstance(node, dict):
            node[data.draw(st.text(max_size=5))] = data.draw(values)
        else:
            node.append(data.draw(values))
    try:
        file = parse_model(document, "m.json")
    except DataError as error:
        assert "m.json" in str(error)  # noqa: PT017 - either way is right
        return
    assert isinstance(file, ModelFile)
    with np.errstate(over="ignore", invalid="ignore"):
        outputs = file.operator.evaluate(np.linspace(*file.operator.input_range, 5))
    assert outputs.shape == (5,)
    assert outputs.dtype == np.float64
    json.dumps(file.to_json())
    assert isinstance(file.operator.input_unit, str)
    assert isinstance(file.operator.output_unit, str)


@cases(("name", "key"), [("non-monotonic", "k0"), ("non-monotonic", "high"), ("with a quadratic", "quadratic")])
def test_a_whole_number_of_any_size_is_a_number(name, key):
    document = copy.deepcopy(content(name))
    document["model"]["reversible"][key] = 10**30
    model = parse_model(document, "m.json").operator
    assert model.evaluate(np.linspace(*model.input_range, 5)).dtype == np.float64


def stage(low, high, units):
    return Preisach(uniform_levels(low, high, 4), np.linspace(0.1, 1.0, 10), 0.5, None, None, *units)


FIRST, SECOND = stage(0.0, 3.0, ("V", "N")), stage(-12.0, 12.0, ("N", "m"))
COUPLED = {
    "two-stage": TwoStage(FIRST, SECOND, 0.3),
    "summed": Summed(SECOND, stage(0.0, 3.0, ("V", "m")), 0.3),
    "linear": Linear(3.8, -2.9, SECOND, (0.0, 3.0), 0.3, "V"),
}


class TestCoupled:
    @cases("name", list(COUPLED))
    def test_round_trip(self, tmp_path, name):
        path = tmp_path / "model.json"
        ModelFile(name, COUPLED[name], provenance={"source": "runs"}).save(path)
        loaded = load_model(path)
        assert loaded.name == name
        assert loaded.provenance["source"] == "runs"
        assert type(loaded.model) is type(COUPLED[name])
        voltages, forces = np.array([0.0, 2.5, 1.0, 3.0]), np.array([1.0, 1.0, 4.0, 0.5])
        np.testing.assert_array_equal(
            loaded.model.evaluate(voltages, forces), COUPLED[name].evaluate(voltages, forces)
        )
        assert loaded.to_json() == json.loads(path.read_text(encoding="utf-8"))
        assert loaded.to_json()["kind"] == name

    def test_has_no_operator(self):
        with pytest.raises(DataError, match="model two-stage is of the kind two-stage; expected one of one input"):
            _ = ModelFile("two-stage", COUPLED["two-stage"]).operator

    @cases(
        "change",
        [
            {"model": {"type": "three-stage"}},
            {"model": {"type": "two-stage", "first": 5}},
        ],
    )
    def test_damaged(self, change):
        document = {**ModelFile("two-stage", COUPLED["two-stage"]).to_json(), **change}
        with pytest.raises(DataError, match=r"m\.json"):
            parse_model(document, "m.json")


HYBRID = HybridModel(
    Design().network(),
    Polynomial([-150e-6, -10e-6, 1.6e-6], (-19.2, 19.7), -12e-6, "K", "m"),
    PrandtlIshlinskii(
        np.arange(4) * 10.0, np.array([0.15, 0.03, 0.02, 0.01]) * 1e-6, 2e-7, input_range=(-40.0, 40.0)
    ),
    PUBLISHED_DYNAMICS,
    21.5,
)


class TestHybrid:
    def test_round_trip(self, tmp_path):
        path = tmp_path / "model.json"
        ModelFile("hybrid", HYBRID, provenance={"sources": ["µ", "b"], "rms": 0.1 + 0.2}).save(path)
        loaded = load_model(path)
        assert loaded.provenance["sources"] == ["µ", "b"]
        assert loaded.provenance["rms"] == 0.1 + 0.2
        assert loaded.provenance["bench"]
        assert loaded.to_json() == json.loads(path.read_text(encoding="utf-8"))
        assert loaded.to_json()["kind"] == "hybrid"
        assert loaded.to_json()["name"] == "hybrid"

    def test_what_was_loaded_simulates_the_same(self, tmp_path):
        ModelFile("hybrid", HYBRID).save(tmp_path / "model.json")
        model = load_model(tmp_path / "model.json").model
        assert (model.reference, model.network, model.dynamics) == (21.5, HYBRID.network, PUBLISHED_DYNAMICS)
        assert model.bandwidth() == HYBRID.bandwidth()
        t = np.arange(200.0)
        currents, voltages = 0.05 * np.sin(0.03 * t), 30.0 * np.sin(0.4 * t)
        for name in ("deflections", "thermal", "piezo", "temperatures"):
            np.testing.assert_array_equal(
                getattr(model.simulate(currents, voltages, 1.0), name),
                getattr(HYBRID.simulate(currents, voltages, 1.0), name),
            )

    def test_no_kind_passes_for_another(self, tmp_path):
        path = tmp_path / "m.json"
        for document, kind in ((content(), "preisach"), (ModelFile("x", COUPLED["summed"]).to_json(), "summed")):
            path.write_text(json.dumps(document))
            with pytest.raises(DataError, match=rf"m\.json: expected a model of the kind 'hybrid', got '{kind}'"):
                load_model(path, "hybrid")
        for document in ([], None, "x", {"format": "other"}, {"format": ["bench-model"]}):
            path.write_text(json.dumps(document))
            with pytest.raises(DataError, match=rf"m\.json is not a model file: its `format` is not '{FORMAT}'"):
                load_model(path, "hybrid")


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_any_mutation_of_a_hybrid_model_is_usable_or_a_data_error(tmp_path_factory, data):
    document = json.loads(json.dumps(ModelFile("hybrid", HYBRID).to_json()))
    *parents, key = data.draw(st.sampled_from(list(_paths(document))))
    node = document
    for part in parents:
        node = node[part]
    if data.draw(st.booleans()):
        node[key] = data.draw(values)
    else:
        del node[key]
    path = tmp_path_factory.getbasetemp() / "mutated-hybrid.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    try:
        file = load_model(path)
    except DataError as error:
        assert "mutated-hybrid.json" in str(error)  # noqa: PT017 - either way is right
        return
    with np.errstate(over="ignore", invalid="ignore"):
        assert file.model.thermal_deflection([0.0]).shape == (1,)
    json.dumps(file.to_json())


class TestUnregistered:
    def test_is_refused_when_it_is_saved(self, tmp_path):
        class Other(Polynomial):
            kind = "other"

        with pytest.raises(DataError, match=r"m\.json is not written.*Other.*register it.*bench\.models"):
            ModelFile("other", Other([1.0], (0.0, 1.0))).save(tmp_path / "m.json")
        assert not list(tmp_path.iterdir())

    def test_is_refused_although_its_kind_is_that_of_another(self, tmp_path):
        class Other(Polynomial):
            pass

        with pytest.raises(DataError, match=r"not the class registered for the kind 'polynomial'"):
            ModelFile("other", Other([1.0], (0.0, 1.0))).save(tmp_path / "m.json")

    def test_an_unknown_kind_is_named(self):
        document = content() | {"kind": "spline", "model": {"type": "spline"}}
        with pytest.raises(DataError, match=r"expected a model of the kind .*got 'spline'; other kinds"):
            parse_model(document, "m.json")

    def test_kind_and_type_must_agree(self):
        with pytest.raises(DataError, match="kind: expected 'preisach', the type of the model, got 'polynomial'"):
            parse_model(content() | {"kind": "polynomial"}, "m.json")


def places_of_numbers(document, path=()):
    """Yield the paths of all numbers, of a sequence that of the first."""
    items = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in items:
        if isinstance(value, dict | list):
            yield from places_of_numbers(value, (*path, key))
        elif isinstance(value, int | float) and not isinstance(value, bool) and (isinstance(key, str) or key == 0):
            yield *path, key


@cases(("name", "other"), product(MODELS, [True, "x", [], 10**400]))
def test_nothing_else_is_taken_for_a_number(name, other):
    for place in places_of_numbers(content(name)["model"]):
        with pytest.raises(DataError, match="is damaged"):
            parse_model(changed(content(name), ("model", *place), other), "m.json")


@cases(
    ("key", "value"),
    [("skipped", ""), ("skipped", {}), ("skipped", True), ("rms", "0.1"), ("input", ["u"]), ("time", 1)],
)
def test_what_is_taken_from_the_provenance_has_its_type(key, value):
    with pytest.raises(DataError, match=f"provenance: expected .* for {key}"):
        parse_model(changed(content(), ("provenance", key), value), "m.json")
