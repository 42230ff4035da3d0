"""``python -m flows.run``: composes the config, checks it, runs the one flow and prints the table.

Exit status: 0 done, 1 a defect of ours (with its traceback), 2 input or settings that the user can mend (one line).
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback

# torch's and numba's threads must not spin on shared cores; this has to be said before either is imported
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from flows import compose, config
from flows.batch import batch
from flows.runners import WorkerLost
from tasks.errors import InputError

EXAMPLES = """\
examples:
  python -m flows.run                                             the experiment quick, on the embedded creatures
  python -m flows.run +experiment=table3 dataset=mesh_sequence dataset.path=FILE.npz
  python -m flows.run +experiment=paper                           every table and ablation, and one page that holds them
  python -m flows.run -m bones.max_bones=10,20,30                 one table with a row for every value
  python -m flows.run +ablation=k_1 method=partmm                 one line of the config changed
  python -m flows.run +experiment=paper plan=true                 what would be computed and what it would cost
  python -m flows.run --cfg +experiment=table3                    print the config and run nothing
"""


def main(arguments: list[str] | None = None) -> int:
    """The command line. Returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m flows.run",
        description="GaussiAnimate as a workflow: moving meshes to bones, a skeleton and unseen poses.",
        epilog=_epilog(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="changes to the config (Hydra's syntax)")
    parser.add_argument("-m", "--multirun", action="store_true", help="run every value of KEY=A,B,C, in one table")
    parser.add_argument("--cfg", action="store_true", help="print the resolved config of every case and stop")
    known = parser.parse_args(arguments)
    try:
        run = batch(known.overrides, known.multirun)
        if known.cfg:
            cases = [case for experiment in run.experiments for case in experiment.cases]
            print("---\n".join(f"# {c.dataset} {c.method} {c.variant}\n{config.to_yaml(c)}" for c in cases))
            return 0
        if run.config["plan"]:
            from flows.forecast import show

            show(run, every=run.config["plan"] == "stages")
            return 0
        from flows.sweep import run_batch

        run_batch(run)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except WorkerLost as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:  # the reader of our output, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        print("stopped before anything was run", file=sys.stderr)
        return 130
    return 0


def _epilog() -> str:
    lines = [EXAMPLES, "config groups (GROUP=CHOICE; +experiment=CHOICE and +ablation=CHOICE with a plus):"]
    for group, choices in compose.groups().items():
        lines.append(f"  {group}")
        lines += [f"    {choice:<22} {compose.headline(group, choice)}" for choice in choices]
    lines.append("\nkeys and defaults: python -m flows.run --cfg")
    return "\n".join(lines)


def _leave(status: int) -> None:
    """Ends the process; at once if Prefect's server was lost, whose client would go on calling it for minutes."""
    server = sys.modules.get("flows.server")
    if server and server.lost.is_set():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


if __name__ == "__main__":
    try:
        _leave(main())
    except Exception:
        traceback.print_exc()
        _leave(1)
