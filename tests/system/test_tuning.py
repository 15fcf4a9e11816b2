"""`bench model tune`: the search and its cost, the models beside the specimen, and the file that runs take."""

import math
import tomllib

import numpy as np
import pytest
from cases import cases

from bench.base import ConfigurationError
from bench.batch.tuning.search import (
    FACTOR,
    FAILED,
    MARGIN,
    TuningTrial,
    confirm,
    cost_of,
    get,
    multiplied,
    perturbed_models,
    search,
)
from bench.batch.tuning.tuning_runs import start_of
from bench.control import ControllerSetup, controller_spec, tuning_text
from bench.control.tuning_file import load_tuning
from bench.identification import ModelFile
from bench.models import IdentifiedDynamics, Preisach, ResponseDynamics, TwoStage, uniform_levels
from bench.protocol import find_protocol
from bench.rig import load_rig

FILM = Preisach(uniform_levels(30.0, 70.0, 4), np.ones(10), 20.0, None, (21.0, 84.0), "°C", "1/m")
NUMBERS = {"wait": 8.0, "arrival": {"hold": 0.4}}


def failed(numbers):
    return TuningTrial(numbers, FAILED, 2.0, 1.0, math.inf)


def evaluate(candidates):
    """A bowl about wait = 3 and hold = 1, and a cliff below wait = 2.5."""
    found = []
    for numbers in candidates:
        wait, hold = get(numbers, "wait"), get(numbers, "arrival.hold")
        cost = math.log(wait / 3.0) ** 2 + math.log(hold) ** 2 + 1.0
        found.append(TuningTrial(numbers, cost, cost, 1.0, cost) if wait >= 2.5 else failed(numbers))
    return found


def test_the_search_comes_near_the_best_numbers_and_keeps_off_those_that_fail():
    seen = []
    best = search(NUMBERS, ("wait", "arrival.hold"), evaluate, seen.append, rounds=4)
    assert get(best.numbers, "wait") == pytest.approx(3.0, rel=0.25)
    assert get(best.numbers, "wait") >= 2.5
    assert get(best.numbers, "arrival.hold") == pytest.approx(1.0, rel=0.25)
    # A change that gains less than a hundredth is not taken.
    assert 0.99 * best.cost <= min(trial.cost for trial in seen)
    # Two neighbours of each number and six draws in each round at least, and on where it is better.
    assert 1 + 4 * (2 * 2 + 6) < len(seen) <= 1 + 4 * (2 * 5 + 12)
    waits = [get(trial.numbers, "wait") for trial in seen]
    assert waits[1:4] == pytest.approx([8.0 * FACTOR, 8.0 / FACTOR, 8.0 / FACTOR**2], rel=1e-3)
    assert NUMBERS == {"wait": 8.0, "arrival": {"hold": 0.4}}


def test_numbers_that_gain_only_together_are_found():
    def valley(candidates):
        found = []
        for numbers in candidates:
            wait, hold = math.log(get(numbers, "wait") / 8.0), math.log(get(numbers, "arrival.hold") / 0.4)
            cost = 3.0 - wait + 1.2 * abs(wait - hold)
            found.append(TuningTrial(numbers, cost, cost, 1.0, cost))
        return found

    names = ("wait", "arrival.hold")
    tried = []
    best = search(NUMBERS, names, valley, tried.append)
    # One alone only costs more.
    assert min(trial.cost for trial in tried[:5]) == tried[0].cost == 3.0
    assert best.cost < 2.6


def test_a_whole_number_stays_one_and_changes_by_one_at_least():
    numbers = {"corrections": 4, "arrival": {"hold": 0.4}}
    for factor, found in ((1.7, 7), (1.1, 5), (1.0 / 1.1, 3), (1.0 / 1.7, 2), (0.01, 1)):
        assert multiplied(numbers, "corrections", factor) == {**numbers, "corrections": found}
    assert multiplied(numbers, "corrections+arrival.hold", 1.5) == {"corrections": 6, "arrival": {"hold": 0.6}}


def test_a_search_begins_with_the_numbers_of_the_rig_file_over_those_of_the_controller(tmp_path):
    rig = tmp_path / "rig.toml"
    tables = "[protocols.tracking.tuning.closed-loop-inverse]"
    rig.write_text(f'extends = "vo2"\n{tables}\nclose_enough = 6\narrival = {{ tolerance = 0.02 }}\n')
    spec = controller_spec("target", "closed-loop-inverse")
    setup = ControllerSetup(model=ModelFile("preisach", FILM), limits=(21.0, 84.0))
    table = load_rig(str(rig)).protocols["tracking"]["tuning"]["closed-loop-inverse"]
    found = start_of(table, spec.numbers(setup), spec.tunable)
    assert (found["close_enough"], found["corrections"], found["arrival"]["tolerance"]) == (6.0, 4, 0.02)
    # What is given without decimals need not stay a whole number.
    assert [type(found[name]) for name in ("close_enough", "corrections")] == [float, int]
    assert found["arrival"]["hold"] == spec.numbers(setup).arrival.hold


def test_the_best_in_sessions_that_the_search_has_not_seen_is_taken():
    tried = []
    search(NUMBERS, ("wait", "arrival.hold"), evaluate, tried.append)

    def unseen(candidates):
        # Where the best of the search fails.
        found = evaluate(candidates)
        best = min(found, key=lambda each: each.cost)
        return [failed(each.numbers) if each is best else each for each in found]

    first, best = confirm(tried, [evaluate, unseen])
    assert first.numbers is NUMBERS
    ranked = sorted(tried, key=lambda each: each.cost)
    assert best.numbers == ranked[1].numbers
    assert best.cost < first.cost


def sessions(*costs, rms=1.0):
    """Return sessions in which the first numbers cost so much, or fail where it is None, and all others cost 1."""

    def session(cost):
        first = failed(NUMBERS) if cost is None else TuningTrial(NUMBERS, cost, 1.0, 1.0, 1.0)
        return lambda candidates: [
            first if each is NUMBERS else TuningTrial(each, 1.0, rms, 1.0, 1.0) for each in candidates
        ]

    return [session(cost) for cost in costs]


def test_the_first_numbers_stay_if_none_is_better_in_other_sessions():
    tried = []
    search(NUMBERS, ("wait",), evaluate, tried.append)
    for others, better in (
        # A mean gain of 0.1, by 1.4 standard errors and by 2.5 of them: that of one session may be negative.
        (sessions(1.3, 1.1, 0.9, 1.1, 1.3, 0.9), False),
        (sessions(1.2, 1.2, 0.95, 1.05, 1.1, 1.1), True),
        # An error that is far greater in the worst session is not bought by the time.
        (sessions(1.1, 1.1, 1.1) + sessions(1.1, rms=1.3), False),
        # A session in which the first numbers fail hides no other.
        (sessions(None, 1.1, 0.9, 1.0), True),
        (sessions(None, 0.8, 0.75, 0.8), False),
        (sessions(None, 0.8), True),
    ):
        first, best = confirm(tried, others)
        assert first.numbers is NUMBERS
        assert (best is not first) is better


def test_a_search_begins_with_numbers_that_fail_and_leaves_them():
    tried = []
    best = search({**NUMBERS, "wait": 2.0}, ("wait",), evaluate, tried.append)
    assert tried[0].failed
    assert not best.failed
    first, better = confirm(tried, [evaluate, evaluate])
    assert first.failed
    assert better.numbers == best.numbers
    # Where all fail, none is better.
    first, better = confirm(tried, [lambda candidates: [failed(each) for each in candidates]] * 2)
    assert better is first


def test_the_cost_is_error_and_time_as_multiples_of_those_before():
    assert cost_of(2.0, 10.0, (4.0, 5.0)) == pytest.approx(0.5 + 0.25 * 2.0)
    assert cost_of(2.0, 10.0, (4.0, 5.0), time_weight=1.0) == pytest.approx(0.5 + 2.0)
    assert cost_of(math.inf, math.nan, (4.0, 5.0)) == FAILED
    assert multiplied(NUMBERS, "arrival.hold", 3.0864)["arrival"] == {"hold": 1.235}


def test_other_gains_turn_about_the_middle_of_the_output():
    found = perturbed_models(ModelFile("preisach", FILM))
    assert list(found) == ["gain-high", "gain-low"]
    low, high = FILM.output_range()
    for name, gain in (("gain-high", MARGIN), ("gain-low", 1.0 / MARGIN)):
        least, greatest = found[name].operator.output_range()
        assert greatest - least == pytest.approx(gain * (high - low))
        assert least + greatest == pytest.approx(low + high)


def test_a_muscle_has_other_lengths_and_other_time_constants():
    rising = Preisach(uniform_levels(0.0, 3.0, 4), np.ones(10), 0.0, None, (0.0, 3.0), "V", "N")
    second = Preisach(uniform_levels(-20.0, 20.0, 4), np.full(10, 1e-5), 0.0, None, (-20.0, 20.0), "N", "m")
    dynamics = IdentifiedDynamics(response=ResponseDynamics(4.0, 2.0))
    found = perturbed_models(ModelFile("two-stage", TwoStage(rising, second, 0.3), dynamics=dynamics))
    assert [*found] == ["gain-high", "gain-low", "lag-high", "lag-low"]
    np.testing.assert_allclose(found["gain-high"].model.second.density, MARGIN * second.density)
    assert found["gain-high"].model.first == rising
    pulled = perturbed_models(ModelFile("two-stage", TwoStage(rising, second, 0.3)), force=True)
    np.testing.assert_allclose(pulled["gain-low"].model.first.density, rising.density / MARGIN)
    assert pulled["gain-low"].model.second == second
    assert [found[name].dynamics.response.lag for name in ("lag-high", "lag-low")] == [4.0 * MARGIN, 4.0 / MARGIN]


def test_a_tuning_file_is_read_by_the_parameter_of_a_protocol(tmp_path):
    path = tmp_path / "tuning.toml"
    path.write_text(tuning_text({"closed-loop-inverse": NUMBERS}, {"model": 'a "model".json', "trials": 3}))
    assert load_tuning(path) == {"closed-loop-inverse": NUMBERS}
    assert tomllib.loads(path.read_text())["provenance"] == {"model": 'a "model".json', "trials": 3}
    file = load_rig("vo2")
    for text in (str(path), '{"closed-loop-inverse": {"wait": 8.0, "arrival": {"hold": 0.4}}}'):
        given = {"model": "model.json", "tuning": text}
        parameters = find_protocol("tracking").parse(given, file.roles, file.protocols.get("tracking"))
        assert parameters.tuning == {"closed-loop-inverse": NUMBERS}


@cases(
    ("content", "said"),
    [
        ("[tuning", "not TOML"),
        ("[rig]\na = 1\n", r"expected tables \[tuning.CONTROLLER\]"),
        ("[tuning.latched]\n[x]\n", "has a key 'x'"),
        (None, "cannot be read"),
    ],
)
def test_what_is_no_tuning_file_is_refused(tmp_path, content, said):
    path = tmp_path / "tuning.toml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ConfigurationError, match=said):
        load_tuning(path)
    with pytest.raises(ConfigurationError, match="tuning"):
        find_protocol("tracking").parse({"model": "model.json", "tuning": str(path)})


def test_what_cannot_be_tuned_is_refused_before_a_run(tmp_path, bench):
    model, out = tmp_path / "model.json", ["--out", tmp_path / "tuning.toml", "--runs", tmp_path / "runs"]
    ModelFile("preisach", FILM).save(model)
    twinned = tmp_path / "twinned.toml"
    twinned.write_text('extends = "vo2-hardware"\n[rig]\ntwin = "vo2"\n')
    for arguments, said in (
        (["--rig", twinned, "--controller", "polynomial"], "no numbers that could be tuned"),
        (["--rig", "vo2-hardware"], "is not emulated: give --twin"),
        (["--rig", "vo2", "--controller", "polynomial"], "no numbers that could be tuned"),
        (["--rig", "vo2", "--protocol", "length-control"], "is controlled by tracking"),
        (["--rig", "vo2", "--set", "count"], "expected KEY=VALUE"),
    ):
        code, _, err = bench("model", "tune", model, *arguments, *out)
        assert code == 2
        assert said in " ".join(err.split())
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_a_controller_is_tuned_on_the_emulated_rig(bench, tmp_path):
    model, out = tmp_path / "model.json", tmp_path / "tuning.toml"
    ModelFile("preisach", FILM).save(model)
    code, _, err = bench(
        "model", "tune", model, "--rig", "vo2", "--controller", "integral", "--rounds", "1", "--workers", "1",
        "--set", "count=2", "--set", "readings=1", "--set", "low=500", "--set", "high=1200",
        "--seeds", "1", "--checks", "2", "--runs", tmp_path / "runs", "--out", out,
    )  # fmt: skip
    assert code == 0, err
    content = tomllib.loads(out.read_text(encoding="utf-8"))
    provenance = content["provenance"]
    assert provenance["cost_after"] <= provenance["cost_before"]
    assert provenance["trials"] >= 5
    assert {"gain", "period"} <= content["tuning"]["integral"].keys()
    # The other controllers keep what the rig file has for them.
    assert "latched" in content["tuning"]
