"""Mutation testing: do the tests see a small change of the code that they test?

Run as ``make mutants ARGS="--sample 60 --seed 0"``. Cosmic Ray changes one operator,
number or condition at a time, in a clone of the last commit. A mutant is killed when a
test fails that mirrors its module. An interrupted run continues where it was. The
result is the share of killed mutants, with an exact binomial interval.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import sqlite3
import subprocess
import sys
from pathlib import Path

from benchmarks.common import Row, show, write_json
from rmp_mjx.training.stats import clopper_pearson

TIMEOUT = 900.0
"""Seconds after which a mutant counts as killed: a change can make a loop endless."""

MODULES = (
    *("rmp_mjx/rmp", "rmp_mjx/control", "rmp_mjx/robot"),
    *(f"rmp_mjx/training/learning/{x}.py" for x in ("loss", "advantages", "rollout")),
)
"""What is mutated."""

ALIKE = (
    {"Add", "Sub", "Mul", "Div"},
    {"FloorDiv", "Mod"},
    {"BitAnd", "BitOr"},
    {"Eq", "NotEq", "Lt", "LtE", "Gt", "GtE"},
    {"Is", "IsNot"},
)
"""Operators that replace each other. The others are errors of type, which any test
would see."""


def annotated(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Where annotations begin and end: a type checker tests them."""
    found: list[ast.expr | None] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            found.append(node.returns)
        if isinstance(node, ast.arg | ast.AnnAssign):
            found.append(node.annotation)
    return [
        ((x.lineno, x.col_offset), (x.end_lineno or 0, x.end_col_offset or 0))
        for x in found
        if x is not None
    ]


def counts(operator: str) -> bool:
    """Whether an operator of Cosmic Ray changes what is computed, not only a type."""
    match = re.fullmatch(r"core/Replace\w+Operator_(\w+)_(\w+)", operator)
    if match is None or match[1] == "Delete":
        return True
    return any(set(match.groups()) <= some for some in ALIKE)


def prune(session: Path, clone: Path, sample: int, seed: int) -> int:
    """Leave a random sample of the mutants in a session; how many there were."""
    base = sqlite3.connect(session)
    places = {
        path: annotated((clone / path).read_text())
        for (path,) in base.execute("select distinct module_path from mutation_specs")
    }
    query = """select job_id, module_path, operator_name, start_pos_row, start_pos_col
        from mutation_specs order by module_path, operator_name, occurrence"""
    every = [
        job
        for job, path, operator, *at in base.execute(query)
        if counts(operator)
        and not any(low <= tuple(at) < high for low, high in places[path])
    ]
    chosen = random.Random(seed).sample(every, min(sample, len(every)))
    marks = ",".join("?" * len(chosen))
    for table in ("mutation_specs", "work_items"):
        base.execute(f"delete from {table} where job_id not in ({marks})", chosen)
    base.execute("create table population (size integer)")
    base.execute("insert into population values (?)", (len(every),))
    base.commit()
    return len(every)


def run(tools: Path, folder: Path, sample: int, seed: int) -> list[dict[str, str]]:
    """Test a sample of mutants, or go on with it; what became of each."""
    clone, session = folder / "clone", folder / f"{sample}-{seed}.sqlite"
    config, ray = folder / "config.toml", str(tools / "bin" / "cosmic-ray")
    folder.mkdir(parents=True, exist_ok=True)
    if not clone.exists():
        subprocess.run(["git", "clone", "-q", ".", str(clone)], check=True)
    subprocess.run(["git", "checkout", "-q", "--", "."], cwd=clone, check=True)
    command = f"{sys.executable} -m tests.changed"
    lines = [
        "[cosmic-ray]",
        f"module-path = {json.dumps(MODULES)}",
        f"timeout = {TIMEOUT}",
        'excluded-modules = ["**/__init__.py"]',
        f"test-command = {json.dumps(command)}",
        '[cosmic-ray.distributor]\nname = "local"',
    ]
    config.write_text("\n".join(lines))
    env = os.environ | {
        "PYTHONPATH": str(clone),
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
    }

    def cosmic_ray(*args: str) -> str:
        return subprocess.run(
            [ray, *args], cwd=clone, env=env, check=True, text=True, stdout=-1
        ).stdout

    if not session.exists():
        begun = session.with_suffix(".begun")
        cosmic_ray("init", str(config), str(begun), "--force")
        print(f"{prune(begun, clone, sample, seed)} mutants, {sample} of them drawn")
        begun.rename(session)
    cosmic_ray("exec", str(config), str(session))
    ended = [json.loads(line) for line in cosmic_ray("dump", str(session)).splitlines()]
    return [result_of(*pair) for pair in ended]


def result_of(item: dict, result: dict) -> dict[str, str]:
    """A mutant: its module and place, how it ended, by which test, and the change."""
    (spec,) = item["mutations"]
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", result["output"] or "", re.M)
    changed = re.findall(r"^[-+](?![-+]).*", result["diff"] or "", re.M)
    return {
        "module": spec["module_path"],
        "place": f"{spec['definition_name']}:{spec['start_pos'][0]}",
        "outcome": result["test_outcome"],
        "test": failed[1].split("[")[0] if failed else "",
        "change": "\n".join(changed),
    }


def rows_of(found: list[dict[str, str]]) -> list[Row]:
    """Killed of tried, all together and by room."""
    rooms = sorted({str(Path(x["module"]).parts[1]) for x in found})
    rows = []
    for room in ("", *rooms):
        some = [x for x in found if room in ("", Path(x["module"]).parts[1])]
        killed = sum(x["outcome"] != "survived" for x in some)
        low, high = (100.0 * x for x in clopper_pearson(killed, len(some)))
        note = f"{killed} of {len(some)}; 95 % interval {low:.0f} to {high:.0f} %"
        name = f"killed_{room}" if room else "killed"
        rows.append(Row(name, 100.0 * killed / len(some), "%", note))
    return rows


def main() -> None:
    """Draw, test, print, and write the requested file."""
    parser = argparse.ArgumentParser(description="Mutation testing.")
    parser.add_argument("--sample", type=int, default=60, help="mutants to draw")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--json", type=Path, help="write rows and survivors to this")
    parser.add_argument("--tools", type=Path, default=Path("build/tools"))
    parser.add_argument("--folder", type=Path, default=Path("build/mutants"))
    args = parser.parse_args()
    folder, tools = args.folder.resolve(), args.tools.resolve()
    found = run(tools, folder, args.sample, args.seed)
    rows = rows_of(found)
    show(rows, "Mutants")
    survivors = [x for x in found if x["outcome"] == "survived"]
    for one in survivors:
        print(f"\n{one['module']}, {one['place']}\n{one['change']}")
    if args.json:
        write_json(args.json, rows, seed=args.seed, survivors=survivors)


if __name__ == "__main__":
    main()
