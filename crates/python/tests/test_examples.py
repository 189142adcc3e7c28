"""Every example of a docstring runs, and every public class and method has a docstring."""

import doctest
import inspect

import numpy
import pytest
import squealcast


def documented():
    """Public objects and their methods, with their names."""
    yield "squealcast", squealcast
    for name in squealcast.__all__:
        value = getattr(squealcast, name)
        if name == "__version__":
            continue
        yield name, value
        if inspect.isclass(value) and value.__module__ == "squealcast" and not issubclass(value, (Exception, int, tuple)):
            for member in dir(value):
                if not member.startswith("_"):
                    yield f"{name}.{member}", getattr(value, member)


OBJECTS = list(documented())


def test_everything_public_is_documented():
    assert [name for name, value in OBJECTS if not (value.__doc__ or "").strip()] == []


@pytest.mark.parametrize(("name", "value"), [pytest.param(*each, id=each[0]) for each in OBJECTS if ">>>" in (each[1].__doc__ or "")])
def test_example(name, value):
    globs = {"squealcast": squealcast, "numpy": numpy}
    test = doctest.DocTestParser().get_doctest(value.__doc__, globs, name, None, 0)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    report = []
    runner.run(test, out=report.append)
    assert runner.failures == 0, "".join(report)
    assert runner.tries == len(test.examples) > 0


def test_most_methods_have_an_example():
    assert sum(">>>" in (value.__doc__ or "") for _, value in OBJECTS) >= 14
