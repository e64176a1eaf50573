"""Progress of nested loops."""

from sliplens.progress import add_note, open_stage, report_each, report_file, report_progress, reporting


def collect(work):
    calls = []
    with reporting(lambda done, total: calls.append((done, total))):
        work()
    return calls


def test_nested_loops_fill_the_part_of_their_item_and_never_go_back():
    def work():
        for count in report_each([2, 4], sizes=[10, 20]):
            for _ in report_each(range(count)):
                pass

    calls = collect(work)
    assert calls == sorted(calls)
    assert calls[-1] == (30, 30)
    assert (5, 30) in calls
    assert {total for _, total in calls} == {30}


def test_a_loop_that_is_left_early_gives_its_bar_back():
    def work():
        for _ in report_each(range(2)):
            for _ in report_each(range(5)):
                break

    assert collect(work) == [(1, 2), (2, 2)]


def test_work_without_a_listener_runs_silently(tmp_path):
    with open_stage("Explain"), reporting(None):
        add_note("a note")
        report_file(tmp_path, "a file")
        report_progress(1, 2)
        assert list(report_each("ab")) == ["a", "b"]
