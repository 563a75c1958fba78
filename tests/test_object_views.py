"""Objects that are learnt from pictures around them: what comes out is the object, and bad pictures are one line."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from saccade.app.cli.main import main
from saccade.app.objects.adding import add_views
from saccade.app.objects.views import cutting, hull, pictures
from saccade.app.objects.views.masks import plain_mask
from saccade.app.objects.views.meshing import mesh_from_views
from saccade.app.objects.views.pictures import Told, evenly, pictures_of
from saccade.app.objects.views.reading import views_of
from saccade.services.camera.trajectories.lens import Lens
from saccade.services.camera.trajectories.trajectory import Asked
from saccade.shared.errors import SaccadeError
from saccade.shared.model.object_card import read_card
from saccade.shared.render.groceries import grocery
from saccade.shared.render.objects import load_mesh
from saccade.shared.render.world import World
from saccade.shared.world.geometry import direction, look_at, pixel_rays, project

SIDE_PX, RANGE_M = 240, 0.6
ELEVATIONS, AZIMUTHS = (0.1, 0.6, 1.1), 10  # of the cameras
GREEN = np.array([70.0, 150.0, 90.0])


def cameras(elevations=ELEVATIONS, azimuths=AZIMUTHS, middle=(0.1, -0.2, 0.05)):
    """Around an object that stands somewhere in the world."""
    turns = 2 * np.pi / azimuths * np.arange(azimuths)
    return [look_at(np.array(middle) + RANGE_M * direction(turn, up), np.array(middle)) for up in elevations
            for turn in turns]


def mesh():
    return grocery(np.random.default_rng([3, 0]), "tea")


def write(folder, poses, count=None, background=GREEN, scale=1.0):
    """Pictures of the object before a plain background that is brighter on one side, with noise, and their poses."""
    folder.mkdir(parents=True, exist_ok=True)
    shown, rng, frames = mesh(), np.random.default_rng(0), []
    focal = 0.75 * SIDE_PX * RANGE_M / float(np.linalg.norm(shown.size_m))
    world = World((shown,), size_px=SIDE_PX, intrinsics_px=(focal, focal, SIDE_PX / 2, SIDE_PX / 2))
    world.show_table(False)
    world.place({shown.name: (np.array([0.1, -0.2, 0.05]), 0.0)})
    for number, camera in enumerate(poses[:count]):
        mask = world.render_masks(camera)[shown.name]
        behind = background * np.linspace(0.9, 1.1, SIDE_PX)[:, None, None] * np.ones((1, SIDE_PX, 1))
        image = np.where(mask[..., None], world.render(camera), behind) + rng.normal(scale=1.5, size=behind.shape)
        Image.fromarray(np.clip(image, 0, 255).astype(np.uint8)).save(folder / f"{number:03}.png")
        Image.fromarray(mask.astype(np.uint8) * 255).save((folder / "masks").mkdir(exist_ok=True) or
                                                          folder / "masks" / f"{number:03}.png")
        matrix = camera.copy()
        matrix[:3, 3] /= scale
        frames.append({"file_path": f"{number:03}.png", "transform_matrix": matrix.tolist()})
    world.close()
    facts = {"fl_x": focal, "fl_y": focal, "cx": SIDE_PX / 2, "cy": SIDE_PX / 2, "w": SIDE_PX, "h": SIDE_PX}
    (folder / "transforms.json").write_text(json.dumps(facts | {"frames": frames}))
    return folder


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """Pictures from three heights, which no test changes."""
    return write(tmp_path_factory.mktemp("pictures") / "tea", cameras())


@pytest.fixture
def changed(taken, tmp_path):
    """A copy of them."""
    shutil.copytree(taken, tmp_path / "tea")
    return tmp_path / "tea"


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("SACCADE_OBJECTS", str(tmp_path / "sets"))
    return tmp_path / "sets"


@pytest.fixture
def coarse(monkeypatch):
    """A coarse shape, where the test is not about it."""
    monkeypatch.setattr(hull, "FINE", 40)
    monkeypatch.setattr(cutting, "LEVEL", 40)
    monkeypatch.setattr(cutting, "OTHERS", 40)


def made(folder, masks=None, **asked):
    return mesh_from_views(folder, "tea", Told(folder, asked=Asked(**asked)), masks)


def drawn(shown, azimuth):
    world = World((shown,), size_px=64, intrinsics_px=(150, 150, 32, 32))
    world.show_table(False)
    world.place({shown.name: (np.zeros(3), 0.0)})
    image = world.render(look_at(0.7 * direction(azimuth, 0.5), np.zeros(3))).astype(float)
    world.close()
    return image


def test_a_mesh_from_views_has_the_size_the_stand_and_the_look_of_the_object(taken):
    """The pictures are from three heights, none from below, and a pixel is 1.4 mm. The errors of the size stay below
    5 mm, and from each side the two look much more alike than the object from two sides."""
    found, true = made(taken), mesh()
    assert found.views == len(cameras())
    assert found.mesh.size_m == pytest.approx(true.size_m, abs=0.005)
    assert "Its underside was not seen: it is taken to be flat." in found.notes
    assert 0.5 < found.seen < 0.8
    for azimuth in (0.3, 2.0, 4.0):
        error = np.abs(drawn(found.mesh, azimuth) - drawn(true, azimuth)).mean()
        assert error < 0.25 * np.abs(drawn(true, azimuth + 1.5) - drawn(true, azimuth)).mean()


def test_one_round_from_above_is_cut_where_the_outlines_end(tmp_path):
    """From one height alone the outlines meet in a point above and below; a can is flat there."""
    folder = write(tmp_path / "tea", cameras((0.6,), 24))
    found = made(folder)
    assert found.mesh.size_m == pytest.approx(mesh().size_m, abs=0.004)
    assert any("from high above only" in note for note in found.notes)


def called(monkeypatch, *words):
    """The exit code of `saccade objects add`."""
    monkeypatch.setattr(sys, "argv", ["saccade", "objects", "add", *map(str, words), "--yes"])
    with pytest.raises(SystemExit) as end:
        main()
    return end.value.code


def test_an_object_is_added_from_views_with_its_card_and_learnt(taken, home, coarse, monkeypatch):
    """Learning itself is the same as for meshes."""
    learnt = []
    monkeypatch.setattr("saccade.app.objects.adding._learn", lambda objects, folder, console: learnt.append(objects))
    assert called(monkeypatch, "--views", taken, "--poses", taken, "--name", "cup") == 0
    card = read_card(home / "my" / "cup")
    assert (card["source"], card["views"], card["up"]) == ("views", len(cameras()), "z")
    assert "Its underside was not seen: it is taken to be flat." in card["notes"]
    assert learnt == ["my"]
    assert load_mesh("my", "cup").size_m == pytest.approx(mesh().size_m, abs=0.01)


def test_scale_and_up_say_how_the_poses_are_meant(tmp_path, coarse):
    """The file's world is in decimetres, with y up."""
    turn = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    folder = write(tmp_path / "tea", [camera for camera in cameras((0.2, 0.8), 8)], scale=0.1)
    told = json.loads((folder / "transforms.json").read_text())
    for frame in told["frames"]:
        frame["transform_matrix"] = (turn @ np.array(frame["transform_matrix"])).tolist()
    (folder / "transforms.json").write_text(json.dumps(told))
    assert made(folder, up="y", scale=0.1).mesh.size_m == pytest.approx(mesh().size_m, abs=0.012)


# --- what belongs to the object

def test_masks_or_an_alpha_channel_take_the_place_of_a_plain_background(changed):
    rng = np.random.default_rng(1)
    for path in changed.glob("*.png"):
        mask = np.asarray(Image.open(changed / "masks" / path.name)) > 127
        image = np.where(mask[..., None], np.asarray(Image.open(path)), rng.integers(0, 255, (*mask.shape, 3)))
        Image.fromarray(image.astype(np.uint8)).save(path)
    with pytest.raises(SaccadeError, match=r"in 30 of 30 pictures \(000.png, ...\) the background is not plain: put "):
        made(changed)
    by_masks = views_of(changed, Told(changed), changed / "masks")
    for path in changed.glob("*.png"):
        image = Image.open(path)
        image.putalpha(Image.open(changed / "masks" / path.name))
        image.save(path)
    by_alpha = views_of(changed, Told(changed), None)
    assert [view.name for view in by_masks] == [view.name for view in by_alpha]
    for one, other in zip(by_masks, by_alpha, strict=True):
        assert np.array_equal(one.mask, other.mask)
        assert one.intrinsics_px == other.intrinsics_px


def test_a_plain_background_shows_through_a_handle_and_not_through_a_highlight():
    rng = np.random.default_rng(0)
    image = np.tile(GREEN, (200, 200, 1)) * np.linspace(0.85, 1.15, 200)[:, None, None]
    behind = image.copy()
    image[60:140, 50:150] = (200, 30, 40)
    image[80:120, 70:130] = behind[80:120, 70:130]  # one sees through it
    image[125:128, 60:63] = behind[125:128, 60:63]  # a highlight
    image[150:170, 50:150] = 0.88 * behind[150:170, 50:150]  # a soft shadow
    mask = plain_mask(np.clip(image + rng.normal(scale=2, size=image.shape), 0, 255).astype(np.uint8))
    expected = np.zeros((200, 200), dtype=bool)
    expected[60:140, 50:150] = True
    expected[80:120, 70:130] = False
    assert (mask != expected).sum() < 30
    image[:, 170:] = rng.integers(0, 255, (200, 30, 3))
    image[170:] = rng.integers(0, 255, (30, 200, 3))
    assert plain_mask(image.astype(np.uint8)) is None


def test_pictures_whose_outlines_do_not_fit_the_others_are_left_out(changed, coarse):
    for number in (4, 17):
        mask = np.asarray(Image.open(changed / "masks" / f"{number:03}.png"))
        Image.fromarray(np.roll(mask, 60, axis=1)).save(changed / "masks" / f"{number:03}.png")
    found = made(changed, changed / "masks")
    assert found.views == len(cameras()) - 2
    assert "2 pictures are left out, because their outlines do not fit the others." in found.notes
    assert found.mesh.size_m == pytest.approx(mesh().size_m, abs=0.01)


def test_the_distortion_of_a_lens_is_removed_from_a_picture(tmp_path):
    """A point that the lens moves by several pixels is where a pinhole shows it."""
    lens = Lens((200.0, 200.0, 100.0, 80.0), (200, 160), (("k1", -0.25), ("p1", 0.004)))
    ray = np.array([[0.3, 0.2]])
    column, row = lens.pixels(ray)[0]
    assert np.hypot(column - 160, row - 120) > 1.5
    y, x = np.mgrid[:160, :200] + 0.5
    image = np.repeat((200 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / 18))[..., None], 3, axis=2)
    Image.fromarray(image.astype(np.uint8)).save(tmp_path / "0.png")
    facts = {"fl_x": 200, "fl_y": 200, "cx": 100, "cy": 80, "w": 200, "h": 160, "k1": -0.25, "p1": 0.004}
    (tmp_path / "transforms.json").write_text(json.dumps(facts | {"frames": [
        {"file_path": "0.png", "transform_matrix": np.eye(4).tolist()}]}))
    picture, = pictures_of(tmp_path, Told(tmp_path))
    weights = picture.rgb[..., 0].astype(float)
    assert (weights * x).sum() / weights.sum() == pytest.approx(160, abs=0.3)
    assert (weights * y).sum() / weights.sum() == pytest.approx(120, abs=0.3)


def test_a_part_of_a_picture_is_seen_as_the_whole_was(taken, monkeypatch):
    """A point of the object lies in the cut and smaller part where it lay in the picture."""
    monkeypatch.setattr("saccade.app.objects.views.reading.LONGEST_PX", 90)
    for view, camera in list(zip(views_of(taken, Told(taken), None), cameras(), strict=True))[:4]:
        middle = np.argwhere(view.mask).mean(0)[::-1] + 0.5
        whole = np.argwhere(np.asarray(Image.open(taken / "masks" / view.name)) > 127).mean(0)[::-1] + 0.5
        ray = pixel_rays(middle, view.intrinsics_px) @ camera[:3, :3].T
        focal = json.loads((taken / "transforms.json").read_text())["fl_x"]
        shown, _ = project(camera[:3, 3] + ray, camera, (focal, focal, SIDE_PX / 2, SIDE_PX / 2))
        assert shown == pytest.approx(whole, abs=0.7)


# --- bounds

def test_of_many_pictures_some_are_taken_evenly():
    assert evenly(5, 9) == [0, 1, 2, 3, 4]
    assert evenly(100, 4) == [0, 33, 66, 99]


def test_of_a_long_video_fewer_frames_are_taken_the_longer_it_lasts(tmp_path, monkeypatch):
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr(pictures, "MOST", 5)
    writer = cv2.VideoWriter(str(tmp_path / "tea.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, (64, 64))
    for number in range(60):
        writer.write(np.full((64, 64, 3), 4 * number, dtype=np.uint8))
    writer.release()
    lines = [json.dumps({"index": k, "world_from_camera": np.eye(4).tolist()}) for k in range(60)]
    (tmp_path / "poses.jsonl").write_text("\n".join(lines))
    told = Told(tmp_path / "poses.jsonl", (60.0, 60.0, 32.0, 32.0))
    names = [picture.name for picture in pictures_of(tmp_path / "tea.mp4", told)]
    numbers = [int(name.split()[1]) for name in names]
    assert numbers == [*range(10), *range(10, 20, 2), *range(20, 40, 4), *range(40, 60, 8)]


# --- what cannot be used is one line, and nothing is kept

def few(folder):
    for path in sorted(folder.glob("*.png"))[9:]:
        path.unlink()


def one_side(folder):
    for number, path in enumerate(sorted(folder.glob("*.png"))):
        if number % AZIMUTHS > 4:
            path.unlink()


def without_poses(folder):
    for path in folder.glob("*.png"):
        path.rename(folder / f"other_{path.name}")
    (folder / "other_007.png").unlink()  # as many pictures as poses would be taken in the order of their names


def without_intrinsics(folder):
    told = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps({"frames": told["frames"]}))


def mixed(folder):
    told = json.loads((folder / "transforms.json").read_text())
    matrices = [frame["transform_matrix"] for frame in told["frames"]]
    for frame, number in zip(told["frames"], np.random.default_rng(0).permutation(len(matrices)), strict=True):
        frame["transform_matrix"] = matrices[number]
    (folder / "transforms.json").write_text(json.dumps(told))


def cut_off(folder):
    for path in folder.glob("*.png"):
        image = np.asarray(Image.open(path))
        Image.fromarray(np.concatenate([image[100:], np.repeat(image[-1:], 100, axis=0)])).save(path)


def nothing_there(folder):
    for path in folder.glob("*.png"):
        Image.fromarray(np.tile(GREEN.astype(np.uint8), (SIDE_PX, SIDE_PX, 1))).save(path)


def damaged(folder):
    (folder / "003.png").write_bytes((folder / "003.png").read_bytes()[:3000])


@pytest.mark.parametrize(("damage", "words"), [
    (few, "has 9 pictures with a pose, and 12 are needed"),
    (one_side, r"show the object from 5\d% of the directions around it: go all around it"),
    (without_poses, "none of the 29 pictures of .* has a pose in"),
    (without_intrinsics, "nothing tells the focal length of the pictures: give --intrinsics"),
    (mixed, "pictures do not meet in one object: look at the poses with `saccade poses show`"),
    (cut_off, "the picture's border cuts something off: keep the whole object in the picture"),
    (nothing_there, "nothing is seen of the object"),
    (damaged, "picture .*003.png cannot be read"),
])
def test_pictures_that_cannot_be_used_are_one_line_and_nothing_is_kept(changed, home, coarse, damage, words):
    damage(changed)
    with pytest.raises(SaccadeError, match=words) as error:
        add_views(changed, "my", name="tea", told=Told(changed), masks=None, ask=None, console=Console(quiet=True))
    assert "\n" not in str(error.value)
    assert list((home / "my").iterdir()) == []


@pytest.mark.parametrize(("scale", "words"), [
    (0.0005, "object 'tea' would be 0.08.* mm large: give --scale"), (200.0, "m large: give --scale|beyond")])
def test_a_scale_that_no_object_has_is_one_line(taken, coarse, scale, words):
    with pytest.raises(SaccadeError, match=words):
        made(taken, scale=scale)


def test_empty_masks_and_missing_ones_are_told(changed):
    for path in (changed / "masks").glob("*.png"):
        Image.new("L", (SIDE_PX, SIDE_PX)).save(path)
    with pytest.raises(SaccadeError, match=r"in 30 of 30 pictures \(000.png, ...\) nothing is seen of the object"):
        made(changed, changed / "masks")
    shutil.rmtree(changed / "masks")
    with pytest.raises(SaccadeError, match=r"--masks .*masks is not a folder"):
        made(changed, changed / "masks")
    (changed / "masks").mkdir()
    with pytest.raises(SaccadeError, match=r"there is no mask of the picture's name in the folder of --masks"):
        made(changed, changed / "masks")


@pytest.mark.parametrize(("options", "words"), [
    (["--views", "x"], "--views needs --poses"),
    (["--views", "x", "--poses", "y", "a.glb"], "--views takes the place of a mesh"),
    (["a.glb", "--poses", "y"], "are for pictures: give them with --views"),
    ([], "nothing is given to add: give meshes, or pictures with --views and --poses"),
    (["a.glb", "--up=-y"], "in the file of a mesh z or y points up"),
    (["--views", "x", "--poses", "y", "--scale", "0"], "--scale 0: give the length in metres"),
    (["--views", "x", "--poses", "y", "--intrinsics", "1,2"], "write fx,fy,cx,cy"),
    (["--views", "webcam:0", "--poses", "y"], "give a folder of pictures or a video"),
])
def test_options_that_do_not_go_together_are_one_line(home, capsys, monkeypatch, options, words):
    assert called(monkeypatch, *options) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1


def test_a_video_without_pyav_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    Path(tmp_path / "tea.mp4").write_bytes(b"video")
    (tmp_path / "poses.jsonl").write_text(json.dumps({"index": 0, "world_from_camera": np.eye(4).tolist()}))
    with pytest.raises(SaccadeError, match="videos need PyAV"):
        list(pictures_of(tmp_path / "tea.mp4", Told(tmp_path / "poses.jsonl")))
