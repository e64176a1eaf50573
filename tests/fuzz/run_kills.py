"""What is lost when a command is disturbed, and whether the same command, given again, makes good.

Every command that writes is run undisturbed, then with a fault at a moment that is drawn, then again as it was. Faults:
killed (SIGKILL) at a time, killed before its n-th change of a file, interrupted (SIGINT), memory that ends (a limit on
its addresses), a full disk and a read-only one (a small tmpfs of its own, that is given back before the second run),
its unfinished output removed meanwhile, two equal commands at once, the clock set back between and within the runs.

Survived: the first run ends by the fault, with a sentence or well, never with a traceback; the second makes the files
of the undisturbed run, byte for byte, or says a sentence and has changed nothing; no other file is left, nor one in the
temporary folder. Stamps of time in JSON (`finished`, `minutes`) are not compared, nor are the files
of `UNLIKE`. Each run is a fork of this process, which has imported everything. `--keep` notes every outcome in a file
and goes on after those that are there; `--json` ends with one line of JSON.
"""

import hashlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # the children of a process must not inherit its threads
_TESTS = Path(__file__).resolve().parent.parent
sys.path += [str(_TESTS / "fuzz"), str(_TESTS / "helpers")]

import lightning  # noqa: E402, F401 (after the threads are told; imported once for all children)
import numpy as np  # noqa: E402
import pyarrow as pa  # noqa: E402
import torch  # noqa: E402
from changes import count_changes  # noqa: E402
from data_sets import save_dataset  # noqa: E402
from hostile import FORMATS  # noqa: E402
from outcomes import in_a_child, parser, resume, tabulate  # noqa: E402
from small import make_recording, save_untrained  # noqa: E402

import sliplens.cli.commands  # noqa: E402
import sliplens.files  # noqa: E402
import sliplens.study.run as study  # noqa: E402
from sliplens.cli import main as command  # noqa: E402
from sliplens.cli.console import say  # noqa: E402
from sliplens.recordings import load_dataset  # noqa: E402
from sliplens.recordings.dataset import JOURNAL_FOLDER  # noqa: E402
from sliplens.results.study import StudyConfig  # noqa: E402

FAULTS = ("kill", "kill at a change", "interrupt", "memory", "disk", "read-only", "removed", "twice", "clock")
UNLIKE = ("*metrics.csv", "*curve.parquet", "imported/run.json")
"""Files that differ after two undisturbed runs: minutes of epochs, and which data set was labelled in place."""
STAMPS = frozenset({"finished", "minutes", "seconds", "seconds_per_frame"})
SURVIVED = ("same", "sentence")
OUTCOMES = (*SURVIVED, "differs", "lost", "orphan", "traceback", "hang")
LONGEST_S = 120.0


@dataclass(frozen=True)
class Case:
    """A command, and what of the material it changes."""

    words: tuple[str, ...]
    copies: tuple[str, ...] = ()
    """Folders of the material that are copied for it, as it writes into them."""
    grows: bool = False
    """Given again it adds to what is there, so that the files of an undisturbed run are not what is to be there."""


_SMALL = ("--image-size", "32", "--epochs", "2", "--batch-size", "11", "--head", "point", "--untouched-share", "0")
_QUICK = ("--method", "grad-cam", "--trials", "1", "--on", "serial")
CASES = {
    "simulate": Case((
        "simulate", "out", "--dry-trials", "3", "--wet-trials", "1", "--frames-per-trial", "20", "--days", "3",
    )),
    "import": Case(("import", "@/own/many.csv", "-o", "out", "--frame-rate", "30", "--splits", "@/splits.csv")),
    "label": Case(("label", "imported", "--mu", "0.5"), copies=("imported",)),
    "label -o": Case(("label", "@/imported", "-o", "out", "--mu", "0.5", "--no-audit")),
    "split": Case(("split", "data", "--splits", "trial"), copies=("data",)),
    "train": Case(("train", "@/data", "-o", "out", *_SMALL)),
    "predict": Case(("predict", "@/run", "@/data", "-o", "out.csv", "--plot", "out.png", "--engine", "torch")),
    "evaluate": Case(("evaluate", "@/run", "@/data", "-o", "out")),
    "explain": Case(("explain", "@/run", "@/data", "-o", "out", "--method", "grad-cam", "integrated-gradients")),
    "score": Case(("score", "@/run", "@/explained", "-o", "out", "--steps", "8")),
    "study": Case(("study", "@/drawn", "-o", "out", "--network", "@/of-drawn", *_QUICK)),
    "track": Case(("track", "@/drawn", "-o", "out.parquet")),
    "export onnx": Case(("export", "onnx", "@/run", "-o", "out.onnx")),
    "live": Case(("live", "@/data", "--speed", "2", "--no-page", "--record", "out"), grows=True),
    "grip": Case(("grip", "-o", "out", "--controller", "margin", "--episodes", "12")),
}  # fmt: skip
"""Every command that writes; @ is the folder of the material."""


@dataclass(frozen=True)
class Fault:
    """One fault: of which command, of which kind, and when, as shares in [0, 1)."""

    case: str
    kind: str
    at: float
    much: float


def faults(count: int, *, seed: int) -> Iterator[Fault]:
    """So many faults, each kind of each command before any comes again."""
    rng = np.random.default_rng(seed)
    pairs = [(case, kind) for case in CASES for kind in FAULTS]
    order: list[int] = []
    for _ in range(count):
        order = order or rng.permutation(len(pairs)).tolist()
        case, kind = pairs[order.pop()]
        yield Fault(case, kind, round(rng.random(), 4), round(rng.random(), 4))


@dataclass
class Ended:
    """How a run ended."""

    code: int
    """Exit code, or minus the signal."""
    said: str
    seconds: float
    facts: dict[str, int] = field(default_factory=dict)
    """What the process told of itself: the files it changed, and how many bytes of addresses it took."""

    @property
    def sentence(self) -> bool:
        """Whether it ended with a sentence, and nothing else."""
        return self.code in {1, 2, 130} and "Traceback" not in self.said and "sliplens: " in self.said

    @property
    def fair(self) -> bool:
        """Whether it ended well, by a signal, or with a sentence; libraries may end the process where memory ends."""
        ended = self.code in {0, *(-one for one in signal.Signals)} - {-signal.SIGALRM} or _BLAS_ENDS in self.said
        return ended or self.sentence


_BLAS_ENDS = "OpenBLAS error: Memory allocation still failed"
"""What OpenBLAS says before it ends the process by itself."""


def _size_of_addresses() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")


class _EarlierClock(datetime):
    """A clock that was set back by a day."""

    @classmethod
    def now(cls, tz: Any = None) -> Any:
        return datetime.now(tz) - timedelta(days=1)


def _set_clock_back() -> None:
    now = time.time
    time.time = lambda: now() - 86_400
    sliplens.files.datetime = _EarlierClock


class Run:
    """A command in a process of its own."""

    def __init__(
        self, words: tuple[str, ...], work: Path, *, kill_before: int | None = None, clock: bool = False,
        room: int | None = None, most_file: int | None = None,
    ) -> None:  # fmt: skip
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 (closed when it has ended)
        self._reader, writer = os.pipe()
        self.began = time.perf_counter()
        self.child = os.fork()
        if self.child:
            os.close(writer)
            return
        try:
            os.setsid()
            os.chdir(work)
            os.dup2(self._log.fileno(), 1)
            os.dup2(self._log.fileno(), 2)
            os.environ["TMPDIR"], tempfile.tempdir = str(work / "tmp"), None
            signal.signal(signal.SIGINT, signal.default_int_handler)
            begin, changes = _size_of_addresses(), count_changes(work, kill_before=kill_before)
            if clock:
                _set_clock_back()
            if room is not None:
                resource.setrlimit(resource.RLIMIT_AS, (begin + room, begin + room))
            if most_file is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (most_file, most_file))
            code = 1
            try:
                code = command(list(words))
            except SystemExit as ended:
                code = ended.code if isinstance(ended.code, int) else 0
            except BaseException:  # whatever there is
                traceback.print_exc()
            sys.stdout.flush()
            peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if "VmPeak" in line)
            told = {"changes": changes(), "room": int(peak.split()[1]) * 1024 - begin}
            os.write(writer, json.dumps(told).encode())
            os._exit(code)
        finally:
            os._exit(70)

    def ended(self, within_s: float) -> bool:
        """Wait so long at most; whether it has ended."""
        until = self.began + within_s
        while not (over := os.waitid(os.P_PID, self.child, os.WEXITED | os.WNOHANG | os.WNOWAIT)):
            if time.perf_counter() >= until:
                break
            time.sleep(0.005)
        return bool(over)

    def end(self, number: int | None = None) -> Ended:
        """Wait until it has ended, of a signal where one is given."""
        if number is not None:
            os.kill(self.child, number)
        hangs = not self.ended(time.perf_counter() - self.began + LONGEST_S)
        if hangs:
            os.killpg(self.child, signal.SIGKILL)
        _, status = os.waitpid(self.child, 0)
        seconds = time.perf_counter() - self.began
        with suppress(ProcessLookupError):
            os.killpg(self.child, signal.SIGKILL)  # what a killed command had started ends with it
        told = os.read(self._reader, 4096)
        os.close(self._reader)
        self._log.seek(0)
        said = self._log.read().decode(errors="replace")
        self._log.close()
        code = -signal.SIGALRM if hangs else os.waitstatus_to_exitcode(status)
        return Ended(code, said, seconds, json.loads(told) if told else {})


def _plain(value: Any) -> Any:
    """JSON without its stamps."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items() if key not in STAMPS}
    return [_plain(one) for one in value] if isinstance(value, list) else value


def snapshot(folder: Path) -> dict[str, str]:
    """A hash of each file, and a word for each empty folder, the temporary ones and all."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_file():
            data = path.read_bytes()
            if path.suffix == ".json":
                with suppress(ValueError):
                    data = json.dumps(_plain(json.loads(data))).encode()
            found[name] = "" if any(fnmatch(name, one) for one in UNLIKE) else hashlib.sha256(data).hexdigest()
        elif path.is_dir() and not any(path.iterdir()):
            found[name] = "folder"
    return found


def make_material(folder: Path) -> None:
    """Small data sets, a network, and its explanations."""
    folder.mkdir(parents=True)
    (folder / "own").mkdir()
    FORMATS["manifest"].make(folder / "own")
    (folder / "own" / "many.csv").write_text(
        "trial,video,forces,day,mu,sensor\n" + "".join(f"{name},cup,forces.csv,1,0.6,tip\n" for name in ("a", "b"))
    )
    (folder / "splits.csv").write_text("trial,split\n*1,train\n*,test\n")
    splits = ["train"] * 3 + ["validation"] * 2 + ["test"] * 2
    trials = [make_recording(f"{split}-{at}", day=1 + at % 3, seed=at) for at, split in enumerate(splits)]
    save_dataset(folder / "data", *trials, split=splits)
    save_untrained(folder / "run")
    save_untrained(folder / "of-drawn", frame_size=224)
    drawn = ("--dry-trials", "5", "--wet-trials", "1", "--frames-per-trial", "40", "--days", "3")
    assert command(["simulate", str(folder / "drawn"), *drawn]) == 0
    own = ["import", str(folder / "own" / "many.csv"), "-o", str(folder / "imported"), "--frame-rate", "30"]
    assert command([*own, "--no-audit"]) == 0
    explained = ("-o", str(folder / "explained"), "--method", "grad-cam")
    assert command(["explain", str(folder / "run"), str(folder / "data"), *explained]) == 0


def shorten_study() -> None:
    """Take few tests, and no page (that of `grip` is one): the whole takes minutes."""
    study.results.SETTINGS = study.results.SETTINGS[:1]
    defaults = {"tests": ("score", "faithfulness", "truth"), "settings": study.results.SETTINGS, "steps": 8}
    StudyConfig.__init__.__kwdefaults__ = {**(StudyConfig.__init__.__kwdefaults__ or {}), **defaults}
    study.JudgingByTruth = partial(study.JudgingByTruth, pairs=2)
    sliplens.cli.commands.draw_report = lambda workspace: None  # noqa: ARG005


class Bench:
    """Runs commands in one place, on a disk of its own where this machine lets it have one."""

    def __init__(self, base: Path) -> None:
        self.material, self.work = base / "material", base / "work"
        in_a_child(lambda: make_material(self.material))
        self.work.mkdir()
        self.own_disk = os.geteuid() == 0 and self.mount("size=1g", new=True)

    def mount(self, options: str, *, new: bool = False) -> bool:
        """Make or change the disk; True if the system lets it."""
        words = ["-t", "tmpfs", "-o", options, "tmpfs"] if new else ["-o", f"remount,{options}"]
        return subprocess.run(["mount", *words, str(self.work)], capture_output=True, check=False).returncode == 0

    def close(self) -> None:
        """Give the disk back."""
        if self.own_disk:
            subprocess.run(["umount", str(self.work)], check=False)

    def prepare(self, case: Case) -> None:
        """Empty the place, and put there what a command changes."""
        for path in self.work.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        (self.work / "tmp").mkdir()
        for name in case.copies:
            shutil.copytree(self.material / name, self.work / name)

    def run(self, case: Case, **limits: Any) -> Run:
        """Begin a command with the material's place in its words."""
        return Run(tuple(word.replace("@", str(self.material)) for word in case.words), self.work, **limits)

    def undisturbed(self, name: str) -> tuple[Ended, dict[str, str]]:
        """How a command ends that nothing disturbs, and what it makes."""
        case = CASES[name]
        self.prepare(case)
        used = shutil.disk_usage(self.work).used
        ended = self.run(case).end()
        if ended.code:
            raise SystemExit(f"{name} fails undisturbed ({ended.code}): {ended.said[-2000:]}")
        ended.facts["bytes"] = shutil.disk_usage(self.work).used - used
        return ended, snapshot(self.work)

    def disturbed(self, fault: Fault, whole: Ended) -> tuple[Ended, ...]:
        """Run a command with a fault; how it ended, and the other one of two."""
        case, moment, facts = CASES[fault.case], fault.at * whole.seconds, whole.facts
        if fault.kind == "disk" and self.own_disk:
            room = shutil.disk_usage(self.work).used + int(fault.at * facts["bytes"]) // 4096 * 4096
            self.mount(f"size={max(room, 4096)}")
        limits: dict[str, Any] = {
            "kill at a change": {"kill_before": 1 + int(fault.at * facts["changes"])},
            "memory": {"room": int(fault.at * facts["room"])},
            "disk": {} if self.own_disk else {"most_file": int(4096 * 4 ** (6 * fault.at))},
            "clock": {"clock": fault.much < 0.5},
        }
        run = self.run(case, **limits.get(fault.kind, {}))
        if fault.kind not in {"kill at a change", "memory", "disk"}:  # these have their moments
            run.ended(0.0 if fault.kind == "read-only" and fault.much < 0.3 else moment)
        second = self.run(case) if fault.kind == "twice" else None
        while fault.kind == "read-only" and not self.mount("ro") and not run.ended(0):
            time.sleep(0.01)  # refused while a file is open to be written
        if fault.kind == "removed":
            for path in [one for one in self.work.iterdir() if one.name not in {"tmp", *case.copies}]:
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
        signals = {"kill": signal.SIGKILL, "clock": signal.SIGKILL, "interrupt": signal.SIGINT}
        ended = [run.end(signals.get(fault.kind)), *([second.end()] if second else [])]
        if self.own_disk:
            self.mount("rw,size=1g")
        if fault.kind == "clock":  # all that is there is of tomorrow
            tomorrow = time.time() + 86_400
            for path in self.work.rglob("*"):
                os.utime(path, (tomorrow, tomorrow), follow_symlinks=False)
        return tuple(ended)

    def outcome(self, fault: Fault, whole: Ended, files: dict[str, str]) -> tuple[str, str]:
        """What became of a fault: survived, or what went wrong, and what was said."""
        case = CASES[fault.case]
        self.prepare(case)
        before = snapshot(self.work)
        runs = self.disturbed(fault, whole)
        how = " and ".join("killed" if one.code < 0 else f"code {one.code}" for one in runs)
        recorded = journalled(self.work / "out") if case.grows else 0
        again = self.run(case).end()
        if unfair := next((one for one in (*runs, again) if not one.fair), None):
            return "hang" if unfair.code == -signal.SIGALRM else "traceback", f"{how}: {unfair.said[-3000:]}"
        if case.grows:
            return self._judge_recording(how, recorded, again)
        found = snapshot(self.work)
        differs = sorted(name for name in {*files, *found} if found.get(name) != files.get(name))
        how = f"{how}, then code {again.code}: {again.said[-300:]}" if again.code else how
        if orphans := [name for name in differs if name not in files and name not in before]:
            return "orphan", f"{how} {orphans[:5]}"
        if again.code:  # what is there is as it was, or whole
            lost = [name for name in differs if found.get(name) != before.get(name)]
            return ("lost" if lost else "sentence"), f"{how} {lost[:5]}"
        return ("differs", f"{how}: {differs[:5]}") if differs else ("same", how)

    def _judge_recording(self, how: str, recorded: int, again: Ended) -> tuple[str, str]:
        if again.code:
            return "lost", f"{how}, then: {again.said[-300:]}"
        data = load_dataset(self.work / "out")
        frames = [info.frames for info in data.trials]
        if sum(frames[:-1]) < recorded:
            return "lost", f"{how}: {recorded} frames were recorded, {frames} are there"
        named = {f"{kind}/{info.trial}.parquet" for info in data.trials for kind in ("trials", "forces")}
        others = sorted({*snapshot(data.folder)} - {*named, "dataset.json"}) + sorted(snapshot(self.work / "tmp"))
        return ("orphan", f"{how}: {others[:5]}") if others else ("same", f"{how}, trials of {frames} frames")


def journalled(folder: Path) -> int:
    """Whole frames that a recording had handed over when it ended."""
    count = 0
    for journal in sorted((folder / JOURNAL_FOLDER).glob("*.arrow")):
        with suppress(pa.ArrowInvalid), pa.memory_map(str(journal)) as file:
            reader = pa.ipc.open_stream(file)
            with suppress(StopIteration, OSError):
                while reader.read_next_batch():
                    count += 1
    return count


def judge(rest: list[Fault], bench: Bench) -> Iterator[tuple[Fault, str, str]]:
    """Outcomes of faults, beside undisturbed runs of their commands."""
    wholes: dict[str, tuple[Ended, dict[str, str]]] = {}
    for number, fault in enumerate(rest, start=1):
        # no bar: its thread may hold a lock at the moment of a fork, which the child would wait for in vain
        say(f"{number} of {len(rest)}: {fault.case}, {fault.kind}", aside=True)
        if fault.case not in wholes:
            wholes[fault.case] = bench.undisturbed(fault.case)
        yield fault, *bench.outcome(fault, *wholes[fault.case])


def main() -> None:
    """Disturb commands, and print a table."""
    options = parser(__doc__, cases="faults", count=20)
    options.add_argument("--only", nargs="*", default=[], metavar="NAME", help="commands or kinds of faults, of those")
    given = options.parse_args()
    torch.set_num_threads(1)
    shorten_study()
    drawn = faults(given.count, seed=given.seed)
    wanted = [one for one in drawn if not given.only or one.case in given.only or one.kind in given.only]
    with tempfile.TemporaryDirectory(prefix="kills-") as base, closing(Bench(Path(base))) as bench:
        if not bench.own_disk:
            print("this machine mounts no disk: a full disk is a limit on the size of a file, none is read-only")
        print(tabulate(
            resume(given.keep, wanted, Fault, lambda rest: judge(rest, bench)), lambda fault: fault.case,
            rows=CASES, columns=OUTCOMES, passed=SURVIVED, as_json=given.json,
        ))  # fmt: skip


if __name__ == "__main__":
    main()
