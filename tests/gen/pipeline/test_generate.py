import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from skope.cli import main
from skope.dataset import coco
from skope.dataset.folder import open_dataset
from skope.gen.inspect.check import check
from skope.gen.pipeline.dataset_store import Store
from tests.gen.small import SMALL, content, gen
from tests.waiting import HANG_S


def test_a_dataset_is_whole(whole: Path) -> None:
    dataset = open_dataset(whole)
    assert dataset.splits == ("medium", "train")
    for split in dataset.splits:
        file = dataset.read(split)
        assert len(file.images) == 5
        assert [image.frame_index for image in file.images] == list(range(5))
        assert [image.time_s for image in file.images] == [0, 0.5, 1.0, 1.5, 2.0]
        for image in file.images:
            assert dataset.image(image).shape == (108, 192, 3)
            depth = dataset.depth(image)
            assert depth is not None
            assert depth.shape == (108, 192)
    assert list(check(dataset)) == []
    assert not (whole / ".work").exists()
    assert dataset.card["counts"]["images"] == 10
    assert dataset.card["localizer_difference_m"]["max"] < 0.5
    assert {"skope", "sumo", "pybullet"} <= dataset.card["versions"].keys()
    assert len(dataset.card["fleet"]["held_out"]) >= 4
    assert "hood_front_left" in dataset.card["fleet"]["substituted"]["van"]


def test_workers_make_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    subprocess.run(gen(tmp_path / "d", "--workers", "2"), check=True, capture_output=True)
    assert content(tmp_path / "d") == content(whole)


@pytest.mark.parametrize("kills", [3, pytest.param(10, marks=pytest.mark.slow)])
def test_killed_at_any_moment_it_goes_on_to_the_same_bytes(kills: int, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    rng = np.random.default_rng(kills)
    seen = []
    while len(seen) < kills:
        process = subprocess.Popen(
            gen(out, "--workers", "1"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        files = len(list(out.rglob("*"))) if out.exists() else 0
        goal, deadline = files + int(rng.integers(1, 8)), time.monotonic() + HANG_S
        while process.poll() is None and time.monotonic() < deadline:
            if out.exists() and len(list(out.rglob("*"))) >= goal:
                break
            time.sleep(0.005)
        if process.poll() is not None:  # it was done before: the next ones are killed from the beginning on
            assert content(out) == content(whole)
            shutil.rmtree(out)
            continue
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        seen.append((out / "dataset.json").exists())
    assert not seen[0]
    subprocess.run(gen(out, "--workers", "1"), check=True, capture_output=True)
    assert content(out) == content(whole)


def test_a_complete_dataset_is_left_alone(whole: Path) -> None:
    before = content(whole)
    result = subprocess.run(gen(whole), check=True, capture_output=True, text=True)
    assert "complete already" in result.stdout
    assert content(whole) == before


def test_other_parameters_are_refused_by_name(whole: Path) -> None:
    result = subprocess.run(gen(whole, "--seed", "1"), capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "seed = 0, now 1" in result.stderr
    assert "frames" not in result.stderr
    assert "Traceback" not in result.stderr


def test_a_folder_of_other_things_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    result = subprocess.run(gen(tmp_path), capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert str(tmp_path) in result.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--preset", "huge"], ["--preset", "huge", "demo"]),
        (["--sites", "nowhere"], ["nowhere", "t01_mill_corner"]),
        (["--sites", ""], ["--sites", "one or more"]),
        (["--sites", "t01_main_west,"], ["--sites", "one or more"]),
        (["--vehicles", ""], ["--vehicles", "one or more"]),
        (["--vehicles", "mine,"], ["--vehicles", "one or more"]),
        (["--vehicles", "mine,mine"], ["--vehicles", "different"]),
        (["--vehicles", "suv"], ["--vehicles suv", "--share"]),
        (["--share", "0.2"], ["--share", "--vehicles"]),
        (["--vehicles", "suv", "--share", "2"], ["--share", "2"]),
        (["--weather", "hail"], ["--weather", "hail", "after_rain"]),
        (["--time-of-day", "noon,"], ["--time-of-day", "low_sun"]),
        (["--site", "nowhere"], ["--site", "nowhere", "t01_mill_corner"]),
        (["--site", "t01_mill_corner", "--sites", "t01_mill_corner"], ["--site", "--sites"]),
        (["--size", "wide"], ["--size", "wide"]),
        (["--size", "0x0"], ["--size"]),
        (["--frames", "0"], ["--frames"]),
        (["--fov", "200"], ["--fov"]),
        (["--workers", "0"], ["--workers"]),
        (["--renderer", "crayon"], ["--renderer", "crayon", "pybullet"]),
        (["--interval", "0.033"], ["--interval"]),
        (["--seed", "-1"], ["--seed"]),
        (["--localizer", "guess"], ["--localizer", "rigid"]),
        (["--occlusion-rule", "none"], ["--occlusion-rule", "others"]),
        (["--min-visible", "2"], ["--min-visible"]),
    ],
)
def test_bad_flags_get_one_line(
    flags: list[str],
    words: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Without OpenGL in this process: on a CPU it and torch's compiler, which a test below loads, bring an LLVM each.
    monkeypatch.setattr(sys, "argv", ["skope", "gen", "--out", str(tmp_path / "d"), "--renderer", "pybullet", *flags])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert all(word in error for word in words)
    assert not (tmp_path / "d").exists()


def test_no_rights_to_write(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    result = subprocess.run(gen(blocked / "d"), capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert str(blocked) in result.stderr


# ------------------------------------------------------------------------------------------------- halves and extension


def skope(*arguments: str, cwd: Path | None = None, **keywords: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "skope", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd, **keywords)  # type: ignore[call-overload, no-any-return]


def test_the_halves_make_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    simulated = skope("gen", "simulate", "--out", str(out), *SMALL, "--workers", "1")
    assert simulated.returncode == 0, simulated.stderr
    assert f"next: skope gen render {out}" in simulated.stdout
    assert not (out / "images").exists()
    # The folder travels to a machine that has neither SUMO nor pybullet.
    elsewhere = tmp_path / "elsewhere"
    out.rename(elsewhere)
    code = (
        "import sys; sys.modules.update(pybullet=None, libsumo=None)\n"
        f"sys.argv = ['skope', 'gen', 'render', {str(elsewhere)!r}, '--workers', '1']\n"
        "from skope.cli import main; main()"
    )
    rendered = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert rendered.returncode == 0, rendered.stderr
    assert content(elsewhere) == content(whole)


def test_rendering_without_recordings(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    result = skope("gen", "render", str(tmp_path / "empty"))
    assert result.returncode == 2
    assert "skope gen simulate" in result.stderr


def test_another_renderer_for_the_rest_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "d"
    skope("gen", "simulate", "--out", str(out), "--sites", "t01_main_west", "--frames", "1", "--workers", "1")
    plan = out / ".work" / "parameters.json"
    values = json.loads(plan.read_text())
    values["parameters"] |= {"renderer": "pybullet", "driver": "a card of 1999"}
    plan.write_text(json.dumps(values))
    result = skope("gen", "render", str(out))
    assert result.returncode == 2
    assert "driver = a card of 1999" in result.stderr
    assert result.stderr.count("\n") == 1


def test_more_sites_and_frames_go_on_from_a_dataset(tmp_path: Path, whole: Path) -> None:
    extended = tmp_path / "extended"
    few = ["--sites", "t01_main_west", "--frames", "3", "--size", "192x108", "--quiet", "--workers", "1"]
    assert skope("gen", "--out", str(extended), *few).returncode == 0
    before = (extended / "images/t01_main_west/00_000002.jpg").stat().st_mtime_ns
    assert skope("gen", "--out", str(extended), *SMALL, "--workers", "1").returncode == 0
    assert content(extended) == content(whole)
    assert (extended / "images/t01_main_west/00_000002.jpg").stat().st_mtime_ns == before
    result = skope("gen", "--out", str(extended), *few)
    assert result.returncode == 2
    assert "frames = " in result.stderr


def test_formats_without_depth(tmp_path: Path) -> None:
    out = tmp_path / "d"
    one = ["--sites", "t01_main_west", "--frames", "1", "--size", "192x108", "--workers", "1"]
    result = skope("gen", "--out", str(out), *one, "--image-format", "webp", "--quality", "80", "--no-depth")
    assert result.returncode == 0, result.stderr
    dataset = open_dataset(out)
    (image,) = dataset.read("medium").images
    assert dataset.image(image).shape == (108, 192, 3)
    assert (out / image.file_name).read_bytes()[8:12] == b"WEBP"
    assert dataset.depth(image) is None
    assert list(check(dataset)) == []
    assert "--image-format webp --quality 80 --no-depth" in dataset.card["command"]


def test_a_full_disk_counts_nothing_as_done(tmp_path: Path, whole: Path) -> None:
    out = tmp_path / "d"
    taken_apart = tmp_path / "apart"
    shutil.copytree(whole, taken_apart)
    Store(taken_apart).reopen()
    files = [path for kind in ("images", "depth", ".work/frames") for path in (taken_apart / kind).rglob("00_*")]
    needed = Counter[str]()
    for path in files:
        needed[f"{path.parent.name}/{path.stem}"] = max(needed[f"{path.parent.name}/{path.stem}"], path.stat().st_size)
    room = max(needed.values()) - 1
    assert needed["t01_mill_corner/00_000000"] <= room

    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))

    assert skope("gen", "simulate", "--out", str(out), *SMALL, "--workers", "1").returncode == 0
    result = skope("gen", "--out", str(out), *SMALL, "--workers", "1", preexec_fn=small_files)
    assert result.returncode == 2
    assert "cannot be written: File too large" in result.stderr
    assert result.stderr.count("\n") == 1
    done = {path.stem for path in (out / ".work" / "frames").rglob("*.jsonl")}
    assert done
    assert all((out / "images" / "t01_mill_corner" / f"{name}.jpg").is_file() for name in done)
    assert not list(out.rglob(".*.part*"))
    # There is room again.
    assert skope("gen", "--out", str(out), *SMALL, "--workers", "1").returncode == 0
    assert content(out) == content(whole)


def test_damaged_labels_of_a_frame_are_named(tmp_path: Path, whole: Path) -> None:
    out = tmp_path / "d"
    shutil.copytree(whole, out)
    Store(out).reopen()
    path = out / ".work/frames/t01_main_west/00_000001.jsonl"
    good = path.read_bytes()
    for bad in (good[:-100], b"{}", b"\n".join(good.split(b"\n")[:-1])):
        path.write_bytes(bad)
        result = skope("gen", "--out", str(out), *SMALL, "--workers", "1")
        assert (result.returncode, result.stderr.count("\n")) == (2, 1)
        assert f"{path}: is damaged; move it away" in result.stderr
    path.unlink()
    assert skope("gen", "--out", str(out), *SMALL, "--workers", "1").returncode == 0
    assert content(out) == content(whole)


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
def test_light_that_is_worked_out_is_told_once_a_site(workers: str, tmp_path: Path) -> None:
    """The towns are in the cache of the tests; the light of this seed is not."""
    flags = ["--sites", "t01_mill_corner,t01_main_west", "--frames", "2", "--size", "64x36", "--workers", workers]
    flags += ["--seed", f"4{workers}"]
    told = []
    for name in ("first", "again"):
        done = skope("gen", "--out", str(tmp_path / name), *flags)
        assert done.returncode == 0, done.stderr
        told.append(sorted(line for line in done.stdout.splitlines() if line.startswith("working out")))
    assert told == [[f"computing the light of {site}" for site in ("t01_main_west", "t01_mill_corner")], []]


def test_a_dataset_that_another_tool_rewrote_goes_on(tmp_path: Path, whole: Path) -> None:
    """Other tools sort the fields of a row."""
    out = tmp_path / "d"
    shutil.copytree(whole, out)
    for path in (out / "annotations").iterdir():
        path.write_text(json.dumps(json.loads(path.read_text()), sort_keys=True))
    Store(out).reopen()
    assert skope("gen", "--out", str(out), *SMALL, "--workers", "1").returncode == 0
    for path in (whole / "annotations").iterdir():
        same = json.loads((out / "annotations" / path.name).read_text())
        assert same == json.loads(path.read_text())


# --------------------------------------------------------------------------------------------------------------- shards


def test_shards_hold_the_same_dataset(whole: Path, tmp_path: Path) -> None:
    sharded, back = tmp_path / "shards", tmp_path / "back"
    for source, target, form in ((whole, sharded, "shards"), (sharded, back, "folder")):
        assert skope("gen", "convert", str(source), str(target), "--to", form).returncode == 0
    assert content(back) == content(whole)
    direct = skope("gen", "--out", str(tmp_path / "direct"), *SMALL, "--workers", "1", "--format", "shards")
    assert direct.returncode == 0, direct.stderr
    assert content(tmp_path / "direct") == content(sharded)
    folder, tars = open_dataset(whole), open_dataset(sharded)
    assert tars.splits == folder.splits
    assert list(check(tars)) == []
    for split in folder.splits:
        one, other = folder.read(split), tars.read(split)
        assert [coco.annotation_to_dict(a) for a in one.annotations] == [
            coco.annotation_to_dict(a) for a in other.annotations
        ]
        for a, b in zip(one.images, other.images, strict=True):
            assert np.array_equal(folder.image(a), tars.image(b))
            assert np.array_equal(folder.depth(a), tars.depth(b))


def test_a_step_learns_the_same_from_shards(whole: Path, tmp_path: Path) -> None:
    """The losses of a training step on an image with vehicles."""
    import torch
    from torchvision.models.detection import keypointrcnn_resnet50_fpn

    from skope.train import splits, training_samples
    from skope.train.augment import Augment
    from skope.train.target_batch import IGNORED_KEY

    skope("gen", "convert", str(whole), str(tmp_path / "s"), "--to", "shards")
    found = []
    for root in (whole, tmp_path / "s"):
        source = splits.read(root, exclude_types=(), val_fraction=0.0, max_images=None)
        assert "-1" not in source.fingerprint
        samples = training_samples.TrainingSet([source], seed=0, augment=Augment(), supervise="all")
        drawn = [samples[(0, position, 0)] for position in range(len(samples))]
        sample = next(one for one in drawn if not isinstance(one, Exception) and len(one.target["boxes"]))
        torch.manual_seed(0)
        model = keypointrcnn_resnet50_fpn(
            weights=None, weights_backbone=None, num_classes=2, num_keypoints=33, min_size=96, max_size=192
        ).train()
        target = {name: value for name, value in sample.target.items() if name != IGNORED_KEY}
        torch.manual_seed(1)
        found.append(model([sample.pixels.float() / 255], [target]))
    assert found[0].keys() == found[1].keys()
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])


def test_shards_are_plain_tar_files(whole: Path, tmp_path: Path) -> None:
    """As a WebDataset reader groups them: members of a frame beside each other, by what stands before the first dot."""
    skope("gen", "convert", str(whole), str(tmp_path / "s"), "--to", "shards")
    with tarfile.open(tmp_path / "s" / "shards" / "train-000000.tar") as tar:
        names = tar.getnames()
        labels = tar.extractfile(names[2])
        assert labels is not None
        frame = json.load(labels)
    assert names[:3] == [f"t01_mill_corner/00_000000{suffix}" for suffix in (".jpg", ".depth.png", ".json")]
    assert frame["image"]["file_name"] == f"shards/train-000000.tar/{names[0]}"
    assert {annotation["image_id"] for annotation in frame["annotations"]} == {frame["image"]["id"]}


def test_a_cut_shard_is_found(whole: Path, tmp_path: Path) -> None:
    skope("gen", "convert", str(whole), str(tmp_path / "s"), "--to", "shards")
    shard = tmp_path / "s" / "shards" / "train-000000.tar"
    shard.write_bytes(shard.read_bytes()[: shard.stat().st_size // 2])
    findings = list(map(str, check(open_dataset(tmp_path / "s"))))
    assert any("train-000000.tar" in finding and "truncated" in finding for finding in findings)


# ------------------------------------------------------------------------------------------------------------------ ray


@pytest.mark.slow
def test_ray_makes_the_same_bytes_though_a_worker_is_lost(whole: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    out = tmp_path / "d"
    process = subprocess.Popen(gen(out, "--engine", "ray", "--workers", "2"), stderr=subprocess.PIPE, text=True)
    killed, deadline = False, time.monotonic() + HANG_S
    while process.poll() is None and time.monotonic() < deadline:
        if not killed and list((out / ".work").glob("frames/*/*.jsonl")):
            workers = subprocess.run(["pgrep", "-f", "ray::Worker.render"], capture_output=True, text=True, check=False)
            for pid in workers.stdout.split()[:1]:
                os.kill(int(pid), signal.SIGKILL)
                killed = True
        time.sleep(0.02)
    assert process.wait() == 0, process.stderr.read() if process.stderr else ""
    assert killed
    assert content(out) == content(whole)


def test_a_ray_worker_with_other_versions_is_refused() -> None:
    from skope.errors import UserError
    from skope.gen.pipeline.ray_workers import Worker

    with pytest.raises(UserError, match=r"has numpy .*; this run uses 1\.0"):
        Worker({"numpy": "1.0"})
