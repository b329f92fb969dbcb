"""Damaged files of every format are refused with an error that names the file, or read.

FUZZ_FILES is the number of damaged files of all formats together, 1000 by default.
"""

import math
import os
import random
import shutil
from pathlib import Path

import pytest

from cart_episodes import make_episode, make_info
from drake_safety import SafetyAssessment, load_scenario
from drake_safety.assessments import shipped_folder
from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.results import Results
from drake_safety.importing.simulatable_urdf import simulatable_copy
from drake_safety.logs.log_map import load_log_map
from drake_safety.logs.robot_log import read_log
from drake_safety.models import load_robot
from drake_safety.robots.meshes import check_meshes
from drake_safety.simulation.dataset import EpisodeWriter, load_episodes
from log_files import FORMATS, ROBOT, map_beside, part, recorded, write
from urdf_files import TETRAHEDRON

pytestmark = pytest.mark.train

NUM_FILES = int(os.environ.get("FUZZ_FILES", "1000"))
LONGEST_MESSAGE = 800
ROOT = Path(__file__).parents[1]
TOKENS = [
    *(b"NaN", b"1e308", b"-1", b"inf", b"[", b"{", b"*a", b"&a [*a]", b"\xff\xfe", b"\x00"),
    *(b"null", b"''", b"1e-9", b"!!python/object:os.system", b"\n", b",", b":", b"<", b">"),
    *(b"[" * 3000, b'{"a":' * 3000, b"9" * 400),
]


def damaged(content, rng):
    data = bytearray(content)
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        place, size = rng.randrange(len(data) + 1), rng.choice([1, 4, 16, 200])
        kind = rng.randrange(6)
        if kind == 0 and place < len(data):
            data[place] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[place : place + size]
        elif kind == 2:
            data[place:place] = rng.choice(TOKENS)
        elif kind == 3:
            del data[place:]
        elif kind == 4:
            data[place:place] = data[place : place + size]
        else:
            data[place : place + size] = rng.choice(TOKENS)
    return bytes(data)


@pytest.fixture(scope="module")
def formats(tmp_path_factory):
    """By format: what is read, the damaged file in it, and the reader."""
    folder, found = tmp_path_factory.mktemp("formats"), {}
    log = part(recorded(0), 0, 41)
    for kind in FORMATS:
        (folder / kind).mkdir()
        path = write(log, folder / kind, kind)
        log_map = map_beside(path)
        inner = path if path.is_file() else next(path.glob("*.db3"))
        found[kind] = path, inner, lambda p, m=log_map: read_log(p, m, ROBOT)
    found["map"] = *[folder / "csv" / "columns.yaml"] * 2, load_log_map
    laikago = ROOT / "models/laikago"
    found["robot"] = laikago, laikago / "robot.yaml", lambda p: load_robot(str(p / "robot.yaml"))
    found["urdf"] = *[next(laikago.glob("*.urdf"))] * 2, simulatable_copy
    for name in ("laikago_balancing", "atlas_reaching"):
        found[name] = *[ROOT / f"diagrams/{name}.yaml"] * 2, load_scenario
    episodes = folder / "episodes"
    with EpisodeWriter(episodes, make_info()) as writer:
        for index in range(6):
            writer.append(make_episode(index))
    found["info"] = episodes, episodes / "info.json", load_episodes
    found["shard"] = episodes, episodes / "episodes-00000.parquet", load_episodes
    found["obj"] = *[folder / "a.obj"] * 2, check_meshes
    (folder / "a.obj").write_text(TETRAHEDRON)
    evaluation = folder / "evaluation.json"
    judged = {("a", "", "b"): proportion(5, 10), ("", "", "c"): Estimate.exact(math.nan, 0)}
    Results(judged, {"command": "c", "seed": 1}).write(evaluation)
    found["evaluation"] = evaluation, evaluation, Results.read
    shipped = shipped_folder("laikago_balancing") / "paper.safetensors"
    found["assessment"] = shipped, shipped, SafetyAssessment.load
    for path, _, reader in found.values():
        reader(path)  # Undamaged.
    return found


NAMES = [*FORMATS, "map", "robot", "urdf", "laikago_balancing", "atlas_reaching", "obj"]
NAMES += ["info", "shard", "evaluation", "assessment"]


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_is_refused_by_name_or_read(name, formats, tmp_path):
    whole, inner, reader = formats[name]
    content, rng = inner.read_bytes(), random.Random(name)
    place = tmp_path / whole.name
    if whole.is_dir():
        shutil.copytree(whole, place)
    file = place / inner.relative_to(whole) if whole.is_dir() else place
    for number in range(-(-NUM_FILES // len(NAMES))):
        data = damaged(content, rng)
        file.write_bytes(data)
        try:
            reader(place)
        except (ValueError, OSError) as error:
            message = str(error)
            assert file.name in message or str(place) in message, (number, message)
            assert len(message) < LONGEST_MESSAGE, (number, message)
        else:
            assert name != "assessment" or data == content, number
