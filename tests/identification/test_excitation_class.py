"""Classes of excitation: each is found, and told from the others."""

import json

import numpy as np
import pytest
from cases import cases
from other_plants import cycles, damped, first_order, random_reversals

from bench.identification.design.excitation_class import ExcitationClass

CLASSES = {
    "damped oscillations": damped,
    "random reversals": random_reversals,
    "first-order reversals from above": first_order,
    "periodic cycles": cycles,
}


@cases("name", CLASSES)
def test_each_is_known_by_name_and_holds_for_its_own_class_only(name):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        found = ExcitationClass.of(CLASSES[name](rng))
        assert found.kind == name
        for other, make in CLASSES.items():
            assert bool(found.departures(make(rng))) == (other != name)


def multisine(rng):
    """Eight frequencies of random phases, three periods."""
    t = np.linspace(0.0, 6.0 * np.pi, 2400)
    values = sum(np.cos(k * t + phase) for k, phase in enumerate(rng.uniform(0.0, 2.0 * np.pi, 8), start=1))
    return values / np.abs(values).max()


def test_many_multisines_are_told_from_random_reversals():
    rng = np.random.default_rng(0)
    pairs = [(ExcitationClass.of(random_reversals(rng)), random_reversals(rng), multisine(rng)) for _ in range(40)]
    own = np.mean([bool(found.departures(other)) for found, other, _ in pairs])
    another = np.mean([bool(found.departures(other)) for found, _, other in pairs])
    assert own <= 0.1
    assert another >= 0.3


def test_noise_of_the_input_is_no_reversal():
    inputs = random_reversals(np.random.default_rng(0))
    plain, rng = ExcitationClass.of(inputs), np.random.default_rng(1)
    noisy = ExcitationClass.of(inputs + 0.003 * rng.normal(size=inputs.size))
    assert noisy.reversals <= plain.reversals + 2
    assert not plain.departures(inputs + 0.003 * rng.normal(size=inputs.size))


@cases(("change", "words"), [
    (lambda u: 1.2 * u, "it spans -1.2 to 1.2, not -1 to 1"),
    (lambda u: 0.4 * u, "its swings are distributed otherwise"),
    (lambda u: 0.5 * u + 0.5, "reversals are distributed otherwise"),
    (lambda u: u[:40], "too few to tell its class"),
    (lambda u: 0.0 * u, "it has 0 reversals"),
])  # fmt: skip
def test_departures_are_named(change, words):
    inputs = random_reversals(np.random.default_rng(3))
    assert any(words in text for text in ExcitationClass.of(inputs).departures(change(inputs)))


def test_a_damped_oscillation_has_its_center():
    rng = np.random.default_rng(0)
    found = ExcitationClass.of(damped(rng))
    assert found.center == pytest.approx(0.0, abs=0.05)
    assert found.departures(damped(rng, center=0.3))[0].startswith("it dies out at 0.3")


def test_growing_oscillations():
    assert ExcitationClass.of(damped(np.random.default_rng(0))[::-1]).kind == "growing oscillations"


def test_what_is_written_is_read():
    for make in CLASSES.values():
        found = ExcitationClass.of(make(np.random.default_rng(0)))
        assert ExcitationClass.from_json(json.loads(json.dumps(found.to_json()))) == found
    for key, value in (("kind", 3), ("low", "x"), ("swings", [1.0]), ("unknown", 1)):
        with pytest.raises(ValueError, match="calibrated_on"):
            ExcitationClass.from_json({**found.to_json(), key: value})
