"""What tests cost is added up by file and by test."""

import pytest
from processor_seconds import NAME, ProcessorSeconds, spent, summary


def test_the_dearest_come_first() -> None:
    costs = {"a.py::test_one": 1.0, "b.py::test_two": 2.5, "a.py::test_three[x::y]": 2.0}
    total, *rows = summary(costs)
    assert total == "processor seconds: 6 in 3 tests"
    assert [row.split() for row in rows if row] == [
        ["3.0", "a.py"],
        ["2.5", "b.py"],
        ["2.5", "b.py::test_two"],
        ["2.0", "a.py::test_three[x::y]"],
        ["1.0", "a.py::test_one"],
    ]


def test_what_was_spent_since_a_test_began_comes_with_its_last_report() -> None:
    costs = ProcessorSeconds()
    costs.pytest_runtest_logstart()
    until = spent() + 0.05
    while spent() < until:
        sum(range(1000))
    for when in ("call", "teardown"):
        call = pytest.CallInfo.from_call(lambda: None, when)
        making = costs.pytest_runtest_makereport(call)
        next(making)
        report = pytest.TestReport("a.py::test", ("a.py", 1, "test"), {}, "passed", None, when)
        with pytest.raises(StopIteration):
            making.send(report)
        assert [name for name, _ in report.user_properties] == [NAME] * (when == "teardown")
        costs.pytest_runtest_logreport(report)
    # The clock ticks in hundredths.
    assert 0.045 < costs.of_tests["a.py::test"] < 2.0
