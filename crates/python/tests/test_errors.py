"""Errors are exceptions with the text of the program."""

import numpy as np
import pytest
import squealcast


def text_of(call):
    with pytest.raises(squealcast.Error) as raised:
        call()
    return raised.type, str(raised.value)


def test_errors_have_the_text_of_the_program(tmp_path, program):
    (tmp_path / "bad.toml").write_text('name = "bad"\n[pad]\nmass = [[1.0, 0.0]]\n')
    for path in ["missing.toml", tmp_path / "bad.toml"]:
        kind, text = text_of(lambda: squealcast.Rig.load(path))
        assert kind is squealcast.RigError and f"error: {text}" == program("check", path)
    rig = squealcast.Rig.load("nine-dof")
    kind, text = text_of(lambda: rig.predict(mu=1e9))
    assert kind is squealcast.PredictionError
    assert f"error: {text}" == program("predict", "nine-dof", "--mu", "1e9")
    kind, text = text_of(lambda: rig.windows(load_n=-1e12))
    assert kind is squealcast.ConditionError
    assert f"error: {text}" == program("critical", "nine-dof", "--load", "-1e12")
    kind, text = text_of(lambda: rig.at_temperature(80.0))
    assert kind is squealcast.RigError
    assert f"error: {text}" == program("predict", "nine-dof", "--temperature", "80")


def test_a_fault_names_its_condition_or_is_marked():
    rig = squealcast.Rig.load("nine-dof-case-2")
    mu = np.array([[0.1, 0.2], [np.nan, 0.4]])
    _, text = text_of(lambda: rig.predict(mu=mu))
    assert text == "nine-dof-case-2, condition [1, 0]: friction_coefficient is NaN, expected a finite number"
    found = rig.predict(mu=mu, on_fault="mark")
    assert found.faults == {2: "friction_coefficient is NaN, expected a finite number"}
    assert found.route[1, 0] == squealcast.Route.FAULT and found.level[1, 0] == squealcast.Level.FAULT
    assert np.isnan(found.eigenvalue_per_s[1, 0]).all() and not np.isnan(found.eigenvalue_per_s[0]).any()


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda rig: rig.predict(mu="much"), "mu: could not convert string to float: 'much', expected numbers"),
        (lambda rig: rig.predict(mu=[0.1, 0.2], load_n=[1.0, 2.0, 3.0]), "shape mismatch"),
        (lambda rig: rig.predict(maps="some"), 'maps is "some", expected "each" or "reference"'),
        (lambda rig: rig.predict(on_fault="hide"), 'on_fault is "hide", expected "raise" or "mark"'),
        (lambda rig: rig.sweep(mu=0.2), "0 arrays, expected one of mu, load_n, speed_rad_s and temperature_c"),
        (lambda rig: rig.sweep(mu=[0.1], load_n=[1.0]), "2 arrays, expected one"),
        (lambda rig: rig.sweep(mu=[0.2, 0.1]), "mu: expected ascending values, at least one"),
        (lambda rig: rig.sweep(mu=[0.2, np.inf]), "mu: expected finite values"),
        (lambda rig: rig.sweep(mu=[0.2], load_n=None, speed_rad_s="fast"), "speed_rad_s"),
        (lambda rig: rig.windows(load_n=[1.0, 2.0]), "conditions of shape [2], expected one number each"),
    ],
)
def test_arguments_that_cannot_be_used_are_condition_errors(call, expected):
    kind, text = text_of(lambda: call(squealcast.Rig.load("nine-dof")))
    assert kind is squealcast.ConditionError and expected in text


def test_every_exception_is_an_error_of_squealcast():
    for name in squealcast.__all__:
        value = getattr(squealcast, name)
        if isinstance(value, type) and issubclass(value, Exception):
            assert issubclass(value, squealcast.Error) and value.__module__ == "squealcast"
