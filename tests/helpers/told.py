"""What every progress callback may rely on."""

from collections.abc import Sequence


def check_told(rows: Sequence[tuple[str, int, int]], stages: Sequence[str]) -> None:
    """Stages come in order, each once; ``done`` never falls, and ends at a ``total`` that stays."""
    assert list(dict.fromkeys(stage for stage, _, _ in rows)) == list(stages)
    for stage in stages:
        places = [k for k, row in enumerate(rows) if row[0] == stage]
        counts = [rows[k][1:] for k in places]
        assert places == list(range(places[0], places[-1] + 1)), stage
        assert [done for done, _ in counts] == sorted(done for done, _ in counts), stage
        assert {total for _, total in counts} == {counts[-1][0]}, stage
