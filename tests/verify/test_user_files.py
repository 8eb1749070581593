"""`jaxslam verify FILE`: what a user's file may hold, and what is said when it is no good."""

import json
import sys
from pathlib import Path

import pytest
from command import run_command

from jaxslam.verify._inputs import user_files

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def verify(tmp_path, capsys):
    """Run `jaxslam verify` on a file of that text: exit status, output, errors, JSON."""

    def go(text, name=""):
        path = tmp_path / "mine.py"
        path.write_text(text, encoding="utf-8")
        return on(str(path) + name)

    def on(target):
        status = run_command(["verify", target, "--out", str(tmp_path / "out")])
        printed = capsys.readouterr()
        result = tmp_path / "out" / "verify.json"
        content = json.loads(result.read_text(encoding="utf-8")) if result.exists() else None
        return status, printed.out, printed.err, content

    def says(text, status, *parts):
        returned, out, _, _ = go(text)
        assert returned == status, out
        for part in parts:
            assert part in out
        return out

    go.on, go.says = on, says
    return go


GOOD = """
import jax.numpy as jnp

def f(pose, u):
    return pose[:2] + u[0] * jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])

def f_jacobian(pose, u):
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    by_pose = jnp.stack([jnp.stack([1.0, 0.0, -u[0] * s]), jnp.stack([0.0, 1.0, u[0] * c])])
    return by_pose, jnp.stack([c, s])[:, None]

f_arguments = {"u": ("forward [m]",)}
f_outputs = ("x [m]", "y [m]")
"""

UNTOLD = """
import numpy as np

def f(pose, u):
    return u

def f_jacobian(pose, u):
    return None, np.eye(len(u))
"""


def test_a_right_claim_passes(verify):
    status, out, err, content = verify(GOOD)
    assert status == 0, out + err
    assert "function f: verified\n" in out
    assert content["passed"] is True
    assert [j["argument"] for j in content["reports"][0]["jacobians"]] == ["pose", "u"]
    assert content["command"].startswith("jaxslam verify ")


def test_a_chart_beside_it_is_said_to_be_left_out(verify):
    text = "import jax.numpy as jnp\nfrom jaxslam import charts\n\nmine = charts.Euclidean()\n"
    text += "\n\ndef f(v):\n    return v\n\n\ndef f_jacobian(v):\n    return jnp.eye(1)\n\n\n"
    text += 'f_arguments = {"v": ("v [m]",)}\n'
    verify.says(text, 0, "verified, with 1 note", "not verified: mine (no chart")


def test_a_wrong_entry_is_named_and_fails(verify):
    status, out, _, content = verify(GOOD.replace("-u[0] * s", "u[0] * s"))
    assert status == 1
    assert "entry (x [m], theta [rad]): hand disagrees with the others" in out
    (wrong,) = content["reports"][0]["jacobians"][0]["wrong_entries"]
    assert (wrong["row"], wrong["column"], wrong["dissent"]) == ("x [m]", "theta [rad]", ["hand"])


def test_williams_and_the_notes_are_caught(verify):
    """The two slips of the sources, by name; nothing else of Williams' is wrong."""
    status, out, _, content = verify.on(str(EXAMPLES / "williams_range_bearing.py"))
    assert status == 1
    wrong = [j["wrong_entries"] for j in content["reports"][0]["jacobians"]]
    entries = [{(e["row"], e["column"]) for e in part} for part in wrong]
    assert entries == [{("range [m]", "x [m]"), ("range [m]", "y [m]")}, set()]
    assert {tuple(e["dissent"]) for e in wrong[0]} == {("hand",)}

    status, out, _, content = verify.on(str(EXAMPLES / "notes_velocity.py"))
    assert status == 1
    by_pose = content["reports"][0]["jacobians"][0]["wrong_entries"]
    slips = {("theta [rad]", "theta [rad]"), ("y [m]", "theta [rad]")}
    assert {(e["row"], e["column"]) for e in by_pose[:2]} == slips
    usual = [e for e in by_pose if e["label"] == "random"]
    assert {(e["row"], e["column"]) for e in usual} == slips
    assert {tuple(e["dissent"]) for e in usual} == {("hand",)}
    assert "notes_velocity.py:19: a value is not finite, " in out  # v/ω at ω = 0
    assert "prints" in out  # the check that it prints nothing was made, and passed
    assert "FAIL  prints" not in out


MODELS = """
import numpy as np
import jaxslam
from jaxslam.core.protocols import Motion, Sensor

robot = jaxslam.motion.Unicycle(0.01 * np.eye(2))

def laser(noise_cov, mount=None) -> Sensor:
    return jaxslam.sensors.RangeBearing(noise_cov, mount)

def helper(x):
    return x
"""


def test_models_and_factories_are_found(verify):
    status, out, _, content = verify(MODELS)
    assert status == 0, out
    assert [(r["kind"], r["model"]) for r in content["reports"]] == [
        ("motion", "robot"),
        ("sensor", "laser"),
    ]
    status, _, _, content = verify(MODELS, ":laser")
    assert status == 0 and [r["model"] for r in content["reports"]] == ["laser"]


def test_the_states_beside_a_model_are_used(verify):
    beside = (
        "import numpy as np\nlaser_states = (np.eye(3), np.full((3, 2), 5.0))\n"
        "laser_outputs = ('range [m]',)\n"
    )
    _, _, _, content = verify(MODELS + beside, ":laser")
    (report,) = content["reports"]
    assert {part["samples"] for part in report["jacobians"]} == {3}
    assert report["notes"] == ["not used: laser_outputs (a model names its entries)"]


@pytest.mark.parametrize(
    ("text", "name", "why"),
    [
        (
            "import nothing_of_this_name\n",
            "",
            "jaxslam: mine.py:1: does not import: ModuleNotFoundError",
        ),
        ("x = 1\nx = = 2\n", "", "mine.py:2: invalid syntax"),
        (
            "x = 1\n\nraise RuntimeError('not today')\n",
            "",
            "mine.py:3: does not import: RuntimeError: not today",
        ),
        ("import sys\nsys.exit(3)\n", "", "mine.py:2: does not import: SystemExit"),
        ("x = 1\n", "", "mine.py: defines nothing to verify"),
        ("", "", "mine.py: defines nothing to verify"),
        (GOOD, ":g", "mine.py: there is no 'g' to verify; it defines: f, f_jacobian"),
        (
            GOOD.replace("f_jacobian", "f_slope"),
            ":f",
            "define f_jacobian, or call jaxslam.verify_jacobians(f)",
        ),
        (UNTOLD, "", "the length of 'u' is not known"),
        (GOOD + "\nf_jacobians = f_jacobian\n", "", "expected f_jacobian or f_jacobians, got both"),
        (GOOD + "\nf_states = (1.0,)\n", "", "states: expected shapes (S, 3), (S, 1)"),
        (MODELS.replace("return jaxslam.sensors", "return 1 / jaxslam.sensors"), "", "mine.py:9: "),
    ],
)
def test_an_unusable_file_is_refused(verify, text, name, why):
    status, _, err, content = verify(text, name)
    assert status == 2
    assert why in err
    assert content is None  # nothing half-written


def test_no_file_and_no_python_file(verify, tmp_path):
    for target, why in (("missing.py", "no such file"), (str(tmp_path), "expected a Python file")):
        status, _, err, _ = verify.on(target)
        assert status == 2
        assert why in err


def test_printing_is_caught_with_its_line(verify):
    text = "print('hello')\n" + GOOD
    assert "hello" not in verify.says(text, 0, "mine.py:1 prints when the file is loaded")
    inside = GOOD.replace("    return pose[:2]", "    print('called')\n    return pose[:2]")
    assert "called" not in verify.says(inside, 1, "prints nothing: mine.py:5 prints")


def test_what_is_wrong_beside_jacobians_is_told_with_its_line(verify):
    branch = GOOD.replace(
        "    return pose[:2]", "    if u[0] > 0:\n        u = 2 * u\n    return pose[:2]"
    )
    # The claim is compared with differences all the same.
    verify.says(branch, 1, "f is traceable: mine.py:5: ", "hand")
    root = GOOD.replace("pose[:2] + u[0]", "pose[:2] + jnp.sqrt(u[0])")
    verify.says(root, 1, "mine.py:5: a value is not")
    one = GOOD.replace('("x [m]", "y [m]")', '("x [m]",)')
    verify.says(one, 1, "(2,) where an array of shape (1,) is expected")


def test_states_of_the_file_are_used(verify):
    states = "\nimport numpy as np\nf_states = (np.ones((5, 3)), np.ones((5, 1)))\n"
    status, out, _, content = verify(GOOD.replace("u[0] * s", "jnp.sqrt(u[0]) * s") + states)
    assert status == 0, out  # it is right at u = 1
    assert content["reports"][0]["jacobians"][0]["samples"] == 5


def test_an_exit_inside_a_model_is_no_success(verify):
    leaves = GOOD.replace("    return pose[:2]", "    import sys; sys.exit(0)\n    return pose[:2]")
    verify.says(leaves, 1, "mine.py:5: SystemExit")


def test_neighbours_can_be_imported_and_nothing_stays_behind(verify, tmp_path):
    (tmp_path / "neighbour.py").write_text("LENGTH = 2.0\n")
    before = list(sys.path)
    status, *_ = verify("from neighbour import LENGTH\n" + GOOD)
    assert status == 0
    assert sys.path == before
    assert not [name for name in sys.modules if name.startswith("_jaxslam_user")]
    sys.modules.pop("neighbour")


FACTORIES = """
from jaxslam import sensors
from jaxslam.core.protocols import Sensor

good = sensors.RangeBearing([[0.1, 0.0], [0.0, 0.1]])

def bad(noise_cov) -> Sensor:
    raise RuntimeError("not finished")

def number(noise_cov) -> Sensor:
    return 3
"""


CLASSES = """
import jax.numpy as jnp
from jaxslam.core.record import record
from jaxslam.motion import Unicycle
from jaxslam.core.protocols import Motion, Sensor

class Shared(Motion):
    controls = noises = ("dx [m]",)

    def step(self, pose, u, w):
        return pose.at[0].add(u[0] + w[0])

@record
class Cart(Shared):
    noise_cov: object

@record
class Fixed(Shared):
    def noise_cov(self, pose, u):
        return jnp.eye(1)

@record
class Scaled(Shared):
    noise_cov: object
    scale: float

mine = Scaled([[0.1]], 2.0)
"""


def test_classes_are_built_where_their_noise_alone_is_missing(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(CLASSES, encoding="utf-8")
    assert [t.name for t in user_files.load(str(path))] == ["Cart", "Fixed", "mine"]
    with pytest.raises(user_files.UnusableFile, match="a class of one whose only required field"):
        user_files.load(f"{path}:Scaled")


def test_only_the_named_factory_is_built(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(FACTORIES, encoding="utf-8")
    assert [t.name for t in user_files.load(f"{path}:good")] == ["good"]
    with pytest.raises(user_files.UnusableFile, match=r"factory bad: .*not finished"):
        user_files.load(f"{path}:bad")
    with pytest.raises(
        user_files.UnusableFile,
        match="the factory number: factory: expected one of a model, got 3",
    ):
        user_files.load(f"{path}:number")
