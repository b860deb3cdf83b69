"""Mutation testing: which mutants count, and which tests they meet."""

import sqlite3
from pathlib import Path

from benchmarks.studies import mutants
from tests.changed import mirrors

SOURCE = '''
def half(x: int | None) -> float | None:
    """Half of it."""
    y: float | None = x / 2
    return y | 0
'''


def test_every_module_that_is_mutated_has_tests(root):
    places = [root / name for name in mutants.MODULES]
    modules = [
        p for place in places for p in (place.rglob("*.py"), [place])[place.is_file()]
    ]
    found = {p.name: mirrors(str(p.relative_to(root))) for p in modules}
    found.pop("__init__.py")
    assert len(found) > 40
    for name, files in found.items():
        assert files and all((root / file).exists() for file in files), name


def test_operators_of_one_kind_replace_each_other():
    core = "core/Replace{}Operator_{}"
    assert mutants.counts(core.format("Binary", "Add_Sub"))
    assert mutants.counts(core.format("Unary", "Delete_Not"))
    assert mutants.counts(core.format("Comparison", "Is_IsNot"))
    assert mutants.counts("core/NumberReplacer")
    assert not mutants.counts(core.format("Binary", "Add_BitOr"))
    assert not mutants.counts(core.format("Comparison", "Lt_Is"))


def test_a_session_keeps_its_sample_without_annotations(tmp_path):
    """The same sample for the same seed, whatever names the jobs have."""
    (tmp_path / "m.py").write_text(SOURCE)
    row, operator = SOURCE.splitlines(), "core/ReplaceBinaryOperator_{}"
    places = [(2, row[1].index("|")), (2, row[1].rindex("|")), (4, row[3].index("|"))]
    real = [(4, row[3].index("/")), (5, row[4].index("|"))]

    def pruned(name, sample, seed):
        base = sqlite3.connect(tmp_path / name)
        base.execute(
            """create table mutation_specs (job_id, module_path, operator_name,
            occurrence, start_pos_row, start_pos_col)"""
        )
        base.execute("create table work_items (job_id)")
        for k, (line, column) in enumerate(places + real):
            job, kind = f"{name}{k}", "Div_Mul" if k == 3 else "BitOr_BitAnd"
            spec = (job, "m.py", operator.format(kind), k, line, column)
            base.execute(f"insert into mutation_specs values {spec}")
            base.execute(f"insert into work_items values ('{job}')")
        base.commit()
        size = mutants.prune(tmp_path / name, tmp_path, sample, seed)
        kept = base.execute("select job_id from work_items order by job_id")
        return size, [job.removeprefix(name) for (job,) in kept]

    assert pruned("a", 9, 0) == (2, ["3", "4"])
    assert pruned("b", 1, 5) == pruned("c", 1, 5)


def test_the_rows_have_exact_intervals():
    """Clopper-Pearson: 9 of 10 is 55.5 to 99.7 %."""
    one = {"module": "rmp_mjx/rmp/leaf.py", "outcome": "killed"}
    found = [one] * 9 + [one | {"outcome": "survived"}]
    every, room = mutants.rows_of(found)
    assert (every.value, every.key, room.key) == (90.0, "killed", "killed_rmp")
    assert every.note == "9 of 10; 95 % interval 55 to 100 %"


def test_a_result_names_the_change_and_the_test_that_saw_it():
    spec = {
        "module_path": "rmp_mjx/rmp/leaf.py",
        "definition_name": "half",
        "start_pos": [4, 3],
    }
    result = {
        "test_outcome": "killed",
        "output": "..F\nFAILED tests/rmp/test_leaves.py::test_x[a-b] - assert 1\n",
        "diff": "--- a\n+++ b\n@@ -4 +4 @@\n x\n-y = 2\n+y = 3\n",
    }
    found = mutants.result_of({"mutations": [spec]}, result)
    assert found["test"] == "tests/rmp/test_leaves.py::test_x"
    assert found["change"] == "-y = 2\n+y = 3"
    assert found["place"] == "half:4"
    assert Path(found["module"]).parts[1] == "rmp"
