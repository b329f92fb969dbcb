import json
import logging
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest

from cart_episodes import assert_identical, make_episode, make_info
from drake_safety.simulation import dataset
from drake_safety.simulation.dataset import EpisodeWriter, completed, load_episodes, read_info

pytestmark = pytest.mark.train
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")


def write(path, episodes, info=None, shard=64):
    """Writes episodes, or those of indices; `shard` of them to a file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "FLUSH_EPISODES", shard)
        with EpisodeWriter(path, info or make_info()) as writer:
            for episode in episodes:
                writer.append(make_episode(episode) if isinstance(episode, int) else episode)


def names_in(path):
    return sorted(file.name for file in path.iterdir() if file.name != ".lock")


STATE = np.array([[np.nan, np.inf, -np.inf], [-0.0, 5e-324, 1 / 3]])
BARE = make_info(feature_names=[])


@pytest.mark.parametrize(
    ("info", "written"),
    [
        (make_info(), [make_episode(1, num_rows=2, state=STATE, cause="diverged")]),
        (make_info(), [make_episode(index, num_rows=1 + index) for index in (3, 0, 2, 1)]),
        (BARE, [make_episode(0, BARE)]),  # Without features.
    ],
)
def test_episodes_come_back_bit_for_bit_sorted_and_writable(tmp_path, info, written):
    write(tmp_path, written, info, shard=3)
    episodes = load_episodes(tmp_path)
    assert episodes.info == info
    assert_identical(episodes, sorted(written, key=lambda episode: episode.index))
    episodes[0].state[:] = 0.0
    assert_identical(episodes[1:2], [make_episode(1, num_rows=2)][: len(episodes) - 1])


def test_info_and_extra_are_plain_json_and_tell_the_command_that_a_set_goes_on_with(tmp_path):
    info = make_info()
    for extra, expected in [
        ({"command": "train --episodes 2", "gain": 0.1}, "train --episodes 2"),
        ({"command": "train --episodes 4"}, "train --episodes 4"),
        (None, "train --episodes 4"),
    ]:
        with EpisodeWriter(tmp_path, info, extra):
            pass
        assert read_info(tmp_path) == (info, {"command": expected, "gain": 0.1})
    content = json.loads((tmp_path / "info.json").read_text())
    assert content["info"]["scenario"] == "cart"


def test_a_shard_is_written_after_some_episodes_or_when_the_last_one_is_old(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset, "FLUSH_EPISODES", 2)
    with EpisodeWriter(tmp_path, make_info()) as writer:
        for index, shards in enumerate([0, 1, 1, 2]):
            writer.append(make_episode(index))
            assert len(names_in(tmp_path)) == 1 + shards
        monkeypatch.setattr(dataset, "FLUSH_S", 0.1)
        time.sleep(0.1)
        writer.append(make_episode(4))
        assert completed(tmp_path) == {0, 1, 2, 3, 4}
    with pytest.raises(ValueError, match="is closed"):
        writer.append(make_episode(5))


def test_a_failed_write_leaves_no_file_and_the_episodes_pending(tmp_path, monkeypatch):
    def fill_the_disk(table, where, **options):
        where.write_bytes(b"PAR1")
        raise OSError("no space left")

    writer = EpisodeWriter(tmp_path / "here", make_info())
    writer.append(make_episode(0))
    with monkeypatch.context() as patch:
        patch.setattr(pq, "write_table", fill_the_disk)
        with pytest.raises(
            OSError, match=r"00000.parquet cannot be written: no space left; its earlier content"
        ):
            writer.flush()
    assert names_in(tmp_path / "here") == ["info.json"]
    shutil.move(tmp_path / "here", tmp_path / "there")
    with pytest.raises(OSError, match=r"here/episodes-00000.parquet cannot be written: No su"):
        writer.flush()
    shutil.move(tmp_path / "there", tmp_path / "here")
    writer.close()
    assert completed(tmp_path / "here") == {0}


def test_a_set_goes_on_after_its_last_shard_and_takes_an_index_once(tmp_path):
    assert completed(tmp_path / "nowhere") == set()
    write(tmp_path, [], make_info())
    assert completed(tmp_path) == set() and len(load_episodes(tmp_path)) == 0
    write(tmp_path, range(3), shard=1)
    (tmp_path / "episodes-00001.parquet").unlink()
    (tmp_path / ".episodes-00001.parquet.123.tmp").write_bytes(b"PAR1 half")
    assert completed(tmp_path) == {0, 2}
    # Names given as a tuple are the same set.
    write(tmp_path, [1], make_info(state_names=("x", "v", "a")))
    assert names_in(tmp_path)[-2:] == ["episodes-00003.parquet", "info.json"]
    assert not list(tmp_path.glob(".*.tmp"))
    with pytest.raises(ValueError, match="episode 1 is already in"):
        write(tmp_path, [3, 1])
    assert completed(tmp_path) == {0, 1, 2, 3}


def test_another_set_is_refused_and_other_package_versions_are_a_warning(tmp_path, caplog):
    write(tmp_path, [0])
    with pytest.raises(ValueError, match="seed: there 7, here 8"):
        EpisodeWriter(tmp_path, make_info(seed=8))
    with caplog.at_level(logging.WARNING, logger="drake_safety"):
        write(tmp_path, [1], make_info(versions={"numpy": "3.0.0"}))
    assert "3.0.0" in caplog.text
    assert read_info(tmp_path)[0].versions == {"numpy": "2.4.6"}


def flip_a_bit(content):
    middle = len(content) // 3
    return content[:middle] + bytes([content[middle] ^ 0x10]) + content[middle + 1 :]


@pytest.mark.parametrize("damage", [lambda c: b"", lambda c: c[: len(c) // 2], flip_a_bit])
def test_a_damaged_shard_is_named(tmp_path, damage):
    write(tmp_path, range(4))
    shard = tmp_path / "episodes-00000.parquet"
    shard.write_bytes(damage(shard.read_bytes()))
    with pytest.raises(ValueError, match=r"shard .*episodes-00000\.parquet is truncated"):
        load_episodes(tmp_path)


def test_a_folder_has_one_writer_at_a_time_and_the_lock_of_a_killed_one_is_gone(tmp_path):
    lock = f"FileLock({str(tmp_path / '.lock')!r})"
    code = f"from filelock import FileLock; lock = {lock}; lock.acquire(); "
    code += "import time; print('locked', flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"locked\n"
        with pytest.raises(ValueError, match=f"{tmp_path} is being written by another process"):
            EpisodeWriter(tmp_path, make_info())
        process.kill()
    write(tmp_path, [0])


def test_an_episode_in_two_shards_is_refused_and_so_are_shards_without_an_info(tmp_path):
    write(tmp_path, [0])
    first = tmp_path / "episodes-00000.parquet"
    second = shutil.copy(first, tmp_path / "episodes-00002.parquet")
    with pytest.raises(ValueError, match=r"episode 0 of .*00002\.parquet is in another shard"):
        load_episodes(tmp_path)
    second.unlink()
    (tmp_path / "info.json").unlink()
    for read in [completed, load_episodes, lambda path: EpisodeWriter(path, make_info())]:
        with pytest.raises(ValueError, match=r"no info\.json"):
            read(tmp_path)
    assert names_in(tmp_path) == ["episodes-00000.parquet"]


@pytest.mark.parametrize(
    ("name", "value"), [("horizon", 10**12), ("step_s", float("nan")), ("state_names", 3)]
)
def test_an_info_with_forged_values_is_refused(tmp_path, name, value):
    write(tmp_path, [0])
    info = json.loads((tmp_path / "info.json").read_text())
    info["info"][name] = value
    (tmp_path / "info.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match=rf"info\.json does not describe episodes: .*{name}"):
        load_episodes(tmp_path)


@pytest.mark.parametrize("changes", [{"state": np.zeros((5, 2))}, {"cause": "moon"}])
def test_an_episode_that_does_not_fit_the_info_is_refused(tmp_path, changes):
    with EpisodeWriter(tmp_path, make_info()) as writer:
        with pytest.raises(ValueError, match=next(iter(changes))):
            writer.append(make_episode(1, **changes))
    assert completed(tmp_path) == set()


def forge(path, name, row, value, type_=None):
    """Writes a shard of a safe and an unsafe episode, with another value or type."""
    write(path, [0, 1])
    shard = path / "episodes-00000.parquet"
    table = pq.read_table(shard)
    place = table.column_names.index(name)
    values = table.column(name).to_pylist()
    values[row] = value if type_ is None else values[row]
    column = pa.array(values, table.schema.field(name).type)
    if type_ is not None:
        column = column.cast(type_)
    pq.write_table(table.set_column(place, name, column), shard)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("margins", 2, [0.1, -0.1]), ": episode 0: it is safe, and a margin is negative"),
        (("is_safe", 3, False), r": episode 0: its rows differ in \['is_safe', 'cause', 'first_s"),
        (("state", 1, [0.0, np.nan, 0.0]), r": episode 0: \['state'\] hold values that are not"),
        (("step", 4, 0), ": episode 0: its steps are not 0, 1, 2"),
        (("time_s", 4, 0.0), ": episode 0: its time does not increase"),
        (("is_safe", 0, 0, pa.string()), " holds no episodes of this set"),
        (("time_s", 0, None), " holds no episodes of this set"),
    ],
)
def test_a_shard_with_forged_content_is_refused_where_it_is_read(tmp_path, change, message):
    forge(tmp_path, *change)
    with pytest.raises(ValueError, match=rf"episodes-00000\.parquet{message}"):
        load_episodes(tmp_path)


def test_a_shard_of_too_many_steps_is_refused_and_a_huge_one_by_its_header(tmp_path, monkeypatch):
    write(tmp_path, [0], make_info(num_steps=3))
    with pytest.raises(ValueError, match="episode 0: it has more than 3 steps"):
        load_episodes(tmp_path)
    monkeypatch.setattr("drake_safety.files.reading._MOST_BYTES", 600)
    with pytest.raises(ValueError, match=r"00000\.parquet would take \S* GB"):
        load_episodes(tmp_path)


def test_where_one_constraint_ends_episodes_the_others_may_be_violated(tmp_path):
    episode = make_episode(0, num_rows=2, margins=np.array([[1.0, 1.0], [1.0, -1.0]]))
    for until in ("wall", "speed"):
        write(tmp_path / until, [episode], make_info(until=until))
    assert len(load_episodes(tmp_path / "wall")) == 1
    with pytest.raises(ValueError, match="it is safe, and a margin is negative"):
        load_episodes(tmp_path / "speed")
