"""The command line: what it writes, its one line for whatever goes wrong, and Ctrl-C."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from small_scene import SCENE

from warpfrag.cli import main
from warpfrag.files.images import read_image
from warpfrag.studies.summary import BEGIN, END

STUDY = """
scene = "scene.toml"
method = "adam"
steps = 60
checkpoint_seconds = 0
[reference.true]
ball.color = [0.2, 0.4, 0.6]
[parameters]
ball.color = [0.8, 0.8, 0.8]
ball.opacity = 0.7
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working folder, with a scene and a study in it."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "study.toml").write_text(STUDY)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_render_writes_an_image(folder):
    """Suffix and bits decide on the format, --size on the size."""
    for name, options in (("a.png", []), ("b.png", ["--bits", "16"]), ("a.exr", []), ("c.png", ["--size", "12x10"])):
        assert main(["render", "scene.toml", "-o", name, *options]) == 0
    assert read_image("c.png").shape == (10, 12, 4)
    np.testing.assert_allclose(read_image("b.png"), read_image("a.exr"), atol=1e-4)
    np.testing.assert_allclose(read_image("a.png"), read_image("a.exr"), atol=1e-2)


def test_render_by_another_method(folder):
    """However fragments are found, the image is the same; a method that does not exist is named."""
    assert main(["render", "scene.toml", "-o", "a.npy"]) == 0
    assert main(["render", "scene.toml", "-o", "b.npy", "--method", "dual_ll"]) == 0
    np.testing.assert_array_equal(np.load("a.npy"), np.load("b.npy"))
    assert main(["render", "scene.toml", "-o", "c.npy", "--method", "f2b_4p"]) == 2


def test_render_overrides(folder):
    """Each override gives the image of a scene file that says the same."""
    changes = [
        (["--beta", "0.1"], ("beta = 0.5", "beta = 0.1")),
        (["--set", "beta=0.1"], ("beta = 0.5", "beta = 0.1")),
        (["--thickness", "0.7", "--set", "disc.thickness=2P"], None),
        (["--merge", "none"], ("beta = 0.5", 'beta = 0.5\nmerge = "none"')),
        (["--layers", "1", "--mix", "average"], ("beta = 0.5", 'beta = 0.5\nlayers = 1\nmix = "average"')),
        (["--background", "#336699"], ("[1, 1, 1]", '"#336699"')),
        (["--background", "0.1,0.2,0.3,0.5"], ("[1, 1, 1]", "[0.1, 0.2, 0.3, 0.5]")),
        (["--background", "none"], ("[1, 1, 1]", "[0, 0, 0, 0]")),
        (["--set", "ball.opacity=0.5", "--set", "ball.color=#ff0000"], None),
    ]
    base = SCENE.replace("segments = 12", "segments = 12\nopacity = 0.8")
    (folder / "scene.toml").write_text(base)
    for options, change in changes:
        assert main(["render", "scene.toml", "-o", "a.npy", *options]) == 0
        if change is not None:
            assert change[0] in base
            (folder / "changed.toml").write_text(base.replace(*change))
            assert main(["render", "changed.toml", "-o", "b.npy"]) == 0
            np.testing.assert_array_equal(np.load("a.npy"), np.load("b.npy"))
    assert np.load("a.npy")[8, 12, :3].tolist() == pytest.approx([1.0, 0.25, 0.25], abs=0.3)


def test_set_moves_objects_and_the_camera(folder):
    """Poses given by --set, in any order, are those of `render`'s parameters."""
    from warpfrag.files.scene_file import load_scene
    from warpfrag.render import render

    poses = {"camera.rotation": (1, -2, 5), "camera.translation": (0.05, 0, 0.1), "ball.translation": (0, 0.1, 0)}
    words = [f"--set={name}={','.join(map(str, value))}" for name, value in poses.items()]
    assert main(["render", "scene.toml", "-o", "a.npy", *words]) == 0
    expected = render(load_scene("scene.toml"), parameters=poses)
    # World coordinates are rounded in other places: a pixel on an edge may change.
    differ = np.abs(np.load("a.npy") - expected).max(axis=2) > 1e-4
    assert differ.mean() < 0.01
    assert np.abs(expected - render(load_scene("scene.toml"))).max() > 0.1


MISTAKES = [
    (["rendr"], "No such command 'rendr'"),
    (["render", "scene.toml"], "Missing option"),
    (["render", "none.toml", "-o", "a.png"], "none.toml: got no such file"),
    (["render", "scene.toml", "-o", "a.jpg"], "a.jpg: got the suffix .jpg"),
    (["render", "scene.toml", "-o", "no/a.png"], "got no folder no"),
    (["render", "scene.toml", "-o", "a.png", "--bits", "12"], "bits: got 12"),
    (["render", "scene.toml", "-o", "a.png", "--beta", "2"], "--beta: got 2, expected a number from 0 to 1"),
    (["render", "scene.toml", "-o", "a.png", "--beta", "x"], '--beta: got "x", expected a number from 0 to 1'),
    (["render", "scene.toml", "-o", "a.png", "--size", "12"], '--size: got "12"'),
    (["render", "scene.toml", "-o", "a.png", "--merge", "smoth"], "merge: "),
    (
        ["render", "scene.toml", "-o", "a.png", "--layers", "0"],
        "--layers: got 0, expected a whole number",
    ),
    (["render", "scene.toml", "-o", "a.png", "--thickness", "2Q"], '--thickness: got "2Q"'),
    (["render", "scene.toml", "-o", "a.png", "--thickness", "-1"], "thickness: "),
    (["render", "scene.toml", "-o", "a.png", "--background", "red"], '--background: got "red"'),
    (["render", "scene.toml", "-o", "a.png", "--set", "beta"], "expected NAME=VALUE"),
    (["render", "scene.toml", "-o", "a.png", "--set", "ball.vertices=1"], "expected a parameter that one line holds"),
    (["render", "scene.toml", "-o", "a.png", "--thickness", "1e300"], "--thickness: got 1e300, expected a number"),
    (["render", "scene.toml", "-o", "a.png", "--set", "bal.opacity=1"], 'did you mean "ball.opacity"?'),
    (["render", "scene.toml", "-o", "a.png", "--set", "ball.opacity=2"], "ball.opacity: "),
    (["render", "scene.toml", "-o", "a.png", "--set", "ball.rotation=1,2"], "expected x,y,z"),
    (["render", "scene.toml", "-o", "a.png", "--set", "camera.rotation=0,nan,0"], "expected x,y,z"),
    (["fit", "none.toml"], "none.toml: got no such file"),
    (["fit", "study.toml", "--steps", "0"], "--steps: got 0"),
    (["fit", "study.toml", "--resume"], "no checkpoint to resume"),
    (["fit"], "fit: got neither STUDY nor --all"),
    (["fit", "study.toml", "--all"], "fit: got both STUDY and --all"),
    (["fit", "study.toml", "--from", "."], "--from: got it without --all"),
    (["fit", "--all"], "experiments/fit: "),
    (["fit", "--all", "--from", "."], "no study, expected folders with a study.py"),
    (["fit", "--all", "--size", "8x8"], "--size: got it with --all"),
    (["fit", ".", "--resume"], "--resume: got it with ., expected it with a study file only"),
    (["fit", "."], "got no study.py in it"),
]


@pytest.mark.parametrize(("words", "message"), MISTAKES)
def test_mistakes_get_one_line(folder, capsys, words, message):
    """One line on standard error, status 2, and no image."""
    assert main(words) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("warpfrag: ")
    assert captured.out == ""
    assert not list(folder.glob("**/*.png"))


def test_unexpected_errors_get_one_line(folder, capsys, monkeypatch):
    """An error nobody thought of is one line too, with its kind; a traceback comes on request."""

    def fail(path):
        raise RuntimeError("two\nlines")

    monkeypatch.setattr("warpfrag.files.scene_file.load_scene", fail)
    words = ["render", "scene.toml", "-o", "a.png"]
    assert main(words) == 2
    assert capsys.readouterr().err == "warpfrag: RuntimeError: two lines\n"
    monkeypatch.setenv("WARPFRAG_TRACEBACK", "1")
    with pytest.raises(RuntimeError):
        main(words)


def test_version_and_help(capsys):
    """Both print and end well."""
    assert main(["--version"]) == 0
    assert main(["--help"]) == 0
    assert main([]) == 0
    assert "render" in capsys.readouterr().out


def test_fit_writes_its_folder(folder, capsys):
    """The default folder is results/<study>; the last line names it."""
    assert main(["fit", "study.toml", "--steps", "3", "--size", "12x8"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "results in results/study"
    content = json.loads(Path("results/study/result.json").read_text())
    assert (content["steps"], content["size"]) == (3, [12, 8])
    assert content["true"]["ball.color"] == pytest.approx([0.2, 0.4, 0.6])


def test_fit_logs_to_tensorboard(folder, capsys, monkeypatch):
    """--tensorboard logs every step, beside the bar, and closes the log."""
    told = []

    class Board:
        def __init__(self, path):
            told.append(path)

        def __enter__(self):
            return lambda progress: told.append(progress.step)

        def __exit__(self, *error):
            told.append("closed")

    # By name it is not found: `warpfrag.fit` is a function to those who ask the package for it.
    monkeypatch.setattr(import_module("warpfrag.fit.tensorboard"), "TensorBoard", Board)
    assert main(["fit", "study.toml", "--steps", "3", "--size", "12x8", "--tensorboard"]) == 0
    assert told == [Path("results/study/tensorboard"), 1, 2, 3, "closed"]


def start(*words: str) -> subprocess.Popen:
    """Start the command line in a process of its own."""
    command = [sys.executable, "-m", "warpfrag", *words]
    return subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def wait_for(path: Path, process: subprocess.Popen, newer_than: float = 0.0) -> None:
    """Wait until a file is there, and newer than a time."""
    while not path.is_file() or path.stat().st_mtime <= newer_than:
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)


@pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")
@pytest.mark.slow
def test_interrupted_and_killed_fit_ends_at_the_same_bits(folder):
    """After Ctrl-C, then kill -9, a resumed fit ends where an unbroken one does; Ctrl-C says how to go on."""
    text = STUDY.replace("steps = 60", "steps = 2000\ntolerance = 0")
    (folder / "study.toml").write_text(text)
    checkpoint = folder / "out" / "checkpoint.dat"
    process = start("fit", "study.toml", "-o", "out")
    wait_for(checkpoint, process)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert told.splitlines()[-1] == "warpfrag: stopped; go on with: warpfrag fit study.toml -o out --resume"
    written = checkpoint.stat().st_mtime
    process = start("fit", "study.toml", "-o", "out", "--resume")
    wait_for(checkpoint, process, written)
    process.kill()
    process.communicate()
    assert not (folder / "out" / "result.json").exists()
    # Few steps are left to do, so that the test is short.
    assert main(["fit", "study.toml", "-o", "out", "--steps", "150", "--resume"]) == 0
    assert main(["fit", "study.toml", "-o", "whole", "--steps", "150"]) == 0
    results = [json.loads((folder / where / "result.json").read_text()) for where in ("out", "whole")]
    assert len(results[1]["losses"]) == 150
    assert results[0]["losses"][:150] == results[1]["losses"]
    assert not list(folder.glob("**/.*partial*"))


GOOD = """
from pathlib import Path
from warpfrag.studies.summary import Summary
print("measuring")
Summary("good", "Good", "Is it?", "It is 1.5.").save(Path(__file__).parent)
"""
# In the words of summary.json, as the package takes its time to import.
BRIEF = """
import json, pathlib
folder = pathlib.Path("results/fit/brief")
(folder / "summary.json").write_text(json.dumps(dict(name="brief", title="Brief", question="?", answer="Yes.")))
"""
FAILING = """
import sys
print("a line")
try:
    raise KeyError("first")
except KeyError:
    raise ValueError("found 3, expected 4\\nand more")
"""
SLEEPING = """
import pathlib, time
pathlib.Path("started").touch()
try:
    time.sleep(600)
finally:
    pathlib.Path("ended").touch()
"""


def add_study(script: str, folder: Path) -> None:
    """Make a study's folder."""
    folder.mkdir(parents=True)
    (folder / "study.py").write_text(script)
    (folder / "README.md").write_text(f"# A study\n\n{BEGIN}\n{END}\n")


def test_fit_all_runs_every_study(folder, capsys):
    """Each study has a line and a row in the report, in the order of their names; status 1 if one failed."""
    studies = folder / "experiments" / "fit"
    scripts = {"good": GOOD, "failing": FAILING, "silent": "", "killed": "import os; os.kill(os.getpid(), 9)"}
    for name, script in scripts.items():
        add_study(script, studies / name)
    (studies / "no_study").mkdir()
    assert main(["fit", "--all"]) == 1
    captured = capsys.readouterr()
    first, last = captured.out.splitlines()
    assert first.startswith("good: It is 1.5. (")
    assert last == "report in results/fit/report.html"
    told = [line for line in captured.err.splitlines() if line.startswith("warpfrag: ")]
    assert told == [
        "warpfrag: failing: ValueError: found 3, expected 4 (more in results/fit/failing/log.txt)",
        "warpfrag: killed: study.py was ended by SIGKILL (more in results/fit/killed/log.txt)",
        "warpfrag: silent: got no new results/fit/silent/summary.json, expected study.py to save a Summary"
        " (more in results/fit/silent/log.txt)",
    ]
    assert (folder / "results" / "fit" / "good" / "log.txt").read_text() == "measuring\n"
    assert "It is 1.5." in (studies / "good" / "README.md").read_text()
    text = (folder / "results" / "fit" / "report.html").read_text()
    assert re.findall(r"ValueError: found 3, expected 4|ended by SIGKILL|got no new results|It is 1.5", text) == [
        "ValueError: found 3, expected 4",
        "It is 1.5",
        "ended by SIGKILL",
        "got no new results",
        "It is 1.5",
    ]


def test_fit_all_from_another_folder(folder, capsys):
    """--from names the studies' folder, --output that of the report; status 0 if all went well."""
    add_study(BRIEF, folder / "elsewhere" / "brief")
    assert main(["fit", "--all", "--from", "elsewhere", "-o", "out"]) == 0
    assert "Yes." in (folder / "out" / "report.html").read_text()


def test_fit_runs_a_study_folder(folder, capsys):
    """A folder with a study.py is run alone, and its report is with its results."""
    add_study(BRIEF, folder / "brief")
    assert main(["fit", "brief"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "report in results/fit/brief/report.html"
    assert "Yes." in (folder / "results" / "fit" / "brief" / "report.html").read_text()


def test_old_summary_does_not_count(folder, capsys):
    """A study that writes no summary has failed, though one of an earlier run is there."""
    add_study(BRIEF, folder / "brief")
    assert main(["fit", "brief"]) == 0
    (folder / "brief" / "study.py").write_text("")
    assert main(["fit", "brief"]) == 1
    assert "got no new" in capsys.readouterr().err


def test_module_is_the_command_line(folder):
    """`python -m warpfrag` does what `warpfrag` does."""
    run = subprocess.run([sys.executable, "-m", "warpfrag", "--version"], capture_output=True, text=True, check=True)
    assert run.stdout.startswith("warpfrag ")


@pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")
def test_interrupted_fit_all_stops_the_study(folder):
    """Ctrl-C reaches the study once; no report is written."""
    add_study(SLEEPING, folder / "studies" / "sleeping")
    process = start("fit", "--all", "--from", "studies")
    wait_for(folder / "started", process)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert told.splitlines()[-1] == "warpfrag: stopped in sleeping (1 of 1); the report is not written"
    assert (folder / "ended").exists()
    assert not list(folder.glob("**/report.html"))


def run(*words: str, **options) -> subprocess.CompletedProcess:
    """Run the command line in a process of its own."""
    return subprocess.run([sys.executable, "-m", "warpfrag", *words], capture_output=True, text=True, **options)


def test_examples_are_listed_rendered_and_copied(folder, capsys):
    """Examples stand for paths, are listed with what they show, and copied with the scenes that they name."""
    assert main(["examples"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("three_spheres ") and "Three translucent spheres" in line for line in lines)
    assert main(["render", "example:three_spheres", "-o", "a.png", "--size", "16x16"]) == 0
    assert main(["examples", "studies/three_spheres", "-o", "mine"]) == 0
    assert sorted(str(path) for path in Path("mine").rglob("*.toml")) == [
        "mine/studies/three_spheres.toml",
        "mine/three_spheres.toml",
    ]
    assert main(["examples", "woven_ball", "-o", "mine"]) == 0
    assert [path.name for path in Path("mine/assets").iterdir()] == ["lattice.png"]
    assert main(["render", "mine/woven_ball.toml", "-o", "a.png", "--size", "16x16"]) == 0
    Path("mine/three_spheres.toml").write_text("changed")
    assert main(["examples", "-o", "mine"]) == 2
    assert "expected none in its place" in capsys.readouterr().err
    assert main(["render", "example:three_sphere", "-o", "a.png"]) == 2
    assert 'did you mean "three_spheres"?' in capsys.readouterr().err


def test_what_a_fit_found_goes_back_in(folder, capsys):
    """`--parameters` gives the values of a result.json to render, inspect and fit; --set comes on top."""
    found = {"ball.color": [0.2, 0.4, 0.6], "ball.opacity": 0.25, "beta": 0.5}
    Path("result.json").write_text(json.dumps({"found": found}))
    words = [f"--set={name}={json.dumps(value).strip('[]')}" for name, value in found.items()]
    assert main(["render", "scene.toml", "-o", "a.npy", "--parameters", "result.json"]) == 0
    assert main(["render", "scene.toml", "-o", "b.npy", *words]) == 0
    np.testing.assert_array_equal(np.load("a.npy"), np.load("b.npy"))
    assert main(["inspect", "scene.toml", "--pixel", "12,8", "--parameters", "result.json", "-o", "p.png"]) == 0
    assert "0.250" in capsys.readouterr().out
    del found["beta"]
    Path("result.json").write_text(json.dumps({"found": found}))
    assert main(["fit", "study.toml", "--steps", "1", "--size", "12x8", "--parameters", "result.json"]) == 0
    assert json.loads(Path("results/study/result.json").read_text())["start"] == found
    Path("result.json").write_text(json.dumps({"found": {"bal.opacity": 1.0}}))
    capsys.readouterr()
    assert main(["render", "scene.toml", "-o", "a.npy", "--parameters", "result.json"]) == 2
    assert 'got the unknown name "bal.opacity"; did you mean "ball.opacity"?' in capsys.readouterr().err


def test_names_that_shells_and_settings_could_misread(folder, capsys):
    """A name with an equals sign can be set; the command that goes on with a fit is quoted for the shell."""
    from warpfrag.cli.fit import _command

    (folder / "scene.toml").write_text(SCENE.replace('"ball"', '"a=b"'))
    assert main(["render", "scene.toml", "-o", "a.npy", "--set", "a=b.opacity=0.5"]) == 0
    assert _command("my $study.toml", None, {"--steps": 3}) == "warpfrag fit 'my $study.toml' --steps 3"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is always full is Linux's")
def test_full_and_closed_streams(folder):
    """What cannot be written is a failure; a closed standard error is none."""
    with open("/dev/full", "w") as full:
        words = [sys.executable, "-m", "warpfrag", "examples"]
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "standard output: cannot be written (No space left on device)" in done.stderr
    os.symlink("/dev/full", "full.png")
    done = run("render", "scene.toml", "-o", "full.png")
    assert (done.returncode, done.stderr) == (
        2,
        "warpfrag: full.png: got a device, expected a file to write or replace\n",
    )
    done = subprocess.run(f"{sys.executable} -m warpfrag render none.toml -o a.png 2>&-", shell=True, check=False)
    assert done.returncode == 2


@pytest.mark.parametrize("size", ["99999x99999", "65537x1", "0x3", "40000x40000"])
def test_sizes_out_of_range_are_named(folder, capsys, size):
    """A size that no image has is refused before anything is allocated."""
    assert main(["render", "scene.toml", "-o", "a.png", "--size", size]) == 2
    assert f'--size: got "{size}", expected width and height' in capsys.readouterr().err


def test_warnings_are_one_line(folder, capfd):
    """What a file leaves out is told in one line, without Python's line of source; Warp's lines on request alone."""
    (folder / "a.obj").write_text("mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nl 1 2\n")
    (folder / "scene.toml").write_text(SCENE + '[[object]]\nmesh = "a.obj"\n')
    done = run("render", "scene.toml", "-o", "a.png")
    assert done.stderr == f"warpfrag: warning: {Path('a.obj').resolve()}: cannot find gone.mtl; lines are not drawn\n"
    assert done.stdout == ""
    assert "Warp" in run("render", "scene.toml", "-o", "a.png", "--verbose").stdout
