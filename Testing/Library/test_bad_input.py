"""Bad input through the command line: one line on the error stream, status 2, no file. And settings and devices."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from volume_samples import save_nrrd

from MedColorLib import Settings, Volume, colorize
from MedColorLib.cli.main import main
from MedColorLib.errors import Cancelled, InputError, MedColorError
from MedColorLib.volume import ColorVolume

pytestmark = pytest.mark.usefixtures("small_raster")


GELATIN = (120, 74, 28)  # as OpenCV stores it


def write_volumes(ct) -> None:
    array, matrix = ct.volume.array[3:6], ct.volume.ijk_to_ras
    save_nrrd(Path("ct.nrrd"), array, matrix)
    save_nrrd(Path("constant.nrrd"), np.full_like(array, 7), matrix)
    save_nrrd(Path("nan.nrrd"), np.full(array.shape, np.nan, np.float32), matrix)
    save_nrrd(Path("voxel.nrrd"), array[:1, :1, :1], matrix)
    Path("short.nrrd").write_bytes(Path("ct.nrrd").read_bytes()[:-500])
    Path("text.nrrd").write_text("this is no image")
    Path("notes.txt").write_text("this is no image")
    Path("empty.nrrd").write_bytes(b"")
    Path("nothing").mkdir()
    colors = np.zeros((*array.shape, 3), np.uint8)
    directions = np.vstack([np.full(3, np.nan), np.eye(3)])
    kinds = ["RGB-color", "domain", "domain", "domain"]
    save_nrrd(Path("rgb.nrrd"), colors, **{"space directions": directions, "kinds": kinds})


def write_pictures(ct) -> None:
    cv2.imwrite("section.png", ct.reference[..., ::-1])
    cv2.imwrite("grey.png", ct.reference[..., 0])
    cv2.imwrite("greyscale.png", np.repeat(ct.reference[..., :1], 3, 2))
    cv2.imwrite("gelatin.png", np.full((80, 90, 3), GELATIN, np.uint8))
    Path("broken.png").write_bytes(Path("section.png").read_bytes()[:3000])
    Path("void.png").write_bytes(b"")
    cv2.imwrite("float.tif", ct.reference.astype(np.float32) / 255)
    cv2.imwrite("slice.png", ct.reference[..., 0])


@pytest.fixture
def folder(ct, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MEDCOLOR_WEIGHTS", raising=False)
    monkeypatch.setattr("MedColorLib.features.weights.cache_folder", lambda: tmp_path / "cache")
    write_volumes(ct)
    write_pictures(ct)
    Path("damaged.safetensors").write_bytes(b"\x10\x00\x00\x00\x00\x00\x00\x00{garbage}")
    return tmp_path


def refused(folder, capfd, *arguments) -> str:
    """The one line that the command prints; status 2 and no new file are checked."""
    before = sorted(p for p in folder.rglob("*"))
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as end:
        status = end.code
    printed = capfd.readouterr()
    assert status == 2, printed
    assert printed.out == "" and printed.err.startswith("medcolor") and printed.err.count("\n") == 1, printed
    assert "Traceback" not in printed.err and len(printed.err) < 400
    assert sorted(p for p in folder.rglob("*")) == before
    return printed.err


def colorize_line(volume="ct.nrrd", reference="section.png", *more):
    return "colorize", volume, "-r", reference, "-o", "out.nrrd", "--preset", "draft", "--features", "embedded", *more


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("gone.nrrd", "gone.nrrd: does not exist"),
        ("text.nrrd", "text.nrrd"),
        ("notes.txt", "endings"),
        ("empty.nrrd", "empty"),
        ("short.nrrd", "short.nrrd"),
        ("nothing", "nothing"),
        ("slice.png", "folder"),
        ("rgb.nrrd", "reference"),
        ("constant.nrrd", "every voxel has the value 7; there is nothing to colour"),
        ("voxel.nrrd", "every voxel has the value"),
        ("nan.nrrd", "no voxel has a finite value; check"),
    ],
)
def test_volumes(folder, capfd, name, words):
    assert words in refused(folder, capfd, *colorize_line(name))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("gone.png", "no file gone.png"),
        ("void.png", "void.png: the file is empty; copy or export it again"),
        ("broken.png", "broken.png"),
        ("notes.txt", "notes.txt: not a picture"),
        ("ct.nrrd", "ct.nrrd: not a colour volume"),
        ("float.tif", "float32 channels; save it with 8 or 16 bits per channel"),
        ("grey.png", "a grey picture; the reference must be a colour photograph"),
        ("greyscale.png", "no colour; use a colour photograph"),
        ("gelatin.png", "no tissue found"),
        ("nothing", "holds no picture"),
    ],
)
def test_references(folder, capfd, name, words):
    assert words in refused(folder, capfd, *colorize_line("ct.nrrd", name))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("-o", "gone/out.nrrd"), "gone does not exist; create it first"),
        (("-o", "out.xyz"), "unknown file ending; use one of .nrrd"),
        (("-o", "nothing"), "nothing"),
        (("-o", "ct.nrrd"), "ct.nrrd is the input; the result would replace it"),
        (("-o", "./nothing/../ct.nrrd"), "is the input"),
        (("--confidence", "ct.nrrd"), "ct.nrrd is the input; the confidence would replace it"),
        (("-o", "ct.nrrd", "--time-points"), "has no other time points"),
        (("-o", "out.nrrd", "--time-points", "--resume"), "leave it out with --time-points"),
        (("-o", "out.nrrd", "--confidence", "out.nrrd"), "is the result; the confidence would replace it"),
        (("--report", "gone/report.json"), "gone does not exist"),
        (("--report", "report.txt"), "use one of .json"),
        (("--device", "cuda:99"), "device 'cuda:99' is not here; present: cpu"),
        (("--device", "toaster"), "device 'toaster' is not here"),
        (("--window", "5", "5"), "window: expected finite LO < HI, got 5 5"),
        (("--window", "nan", "5"), "window: expected finite"),
        (("--window", "1e5", "2e5"), "window 100000 200000: everything would be black, the body's values go from"),
        (("--window", "-2e5", "-1e5"), "window -200000 -100000: everything would be white"),
        (("-r", ""), "argument -r/--reference: the name is empty"),
        (("--labels", ""), "argument --labels: the name is empty"),
        (("--confidence", " "), "argument --confidence: the name is empty"),
        (("--slices", "9:12"), "slices 9:12: the volume has 3 slices (0:3)"),
        (("--slices", "2:1"), "slices: expected 0 <= START < STOP, got 2:1"),
        (("--region", "0", "1", "0", "1", "90", "99"), "lies outside the volume"),
        (("--region", "0", "1", "5", "5", "0", "1"), "region: expected three ranges"),
        (("--coherence", "-1"), "coherence_mm: expected 0 to 1000 mm"),
        (("--seed", "-1"), "seed: expected a whole number"),
        (("--reconstruction", "lbfgs"), "the own features have one"),
        (("--features", "vgg19"), "features vgg19: no weights found; run 'medcolor weights fetch vgg19'"),
    ],
)
def test_options(folder, capfd, options, words):
    assert words in refused(folder, capfd, *colorize_line("ct.nrrd", "section.png", *options))


def test_no_output_named(folder, capfd):
    line = refused(folder, capfd, "colorize", "ct.nrrd", "-r", "section.png", "--features", "embedded")
    assert "name the result with -o OUT.nrrd (or use --plan)" in line


@pytest.mark.parametrize(
    ("weights", "words"),
    [("damaged.safetensors", "damaged.safetensors"), ("gone", "does not exist"), ("notes.txt", "notes")],
)
def test_weights(folder, capfd, monkeypatch, weights, words):
    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(folder / weights))
    line = refused(folder, capfd, *colorize_line("ct.nrrd", "section.png", "--features", "auto", "--preset", "full"))
    assert words in line


def test_own_features_need_no_look_at_weights(folder, monkeypatch):
    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(folder / "gone"))
    assert main([*colorize_line()]) == 0 and main([*colorize_line(), "--features", "auto"]) == 0


def test_plan_finds_the_same_faults(folder, capfd):
    assert "no tissue found" in refused(folder, capfd, "colorize", "ct.nrrd", "-r", "gelatin.png", "--plan")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("render", "gone.nrrd", "-o", "out.png"), "gone.nrrd"),
        (("render", "ct.nrrd", "-o", "out.png"), "ct.nrrd"),
        (("recommend", "ct.nrrd", "--library", "gone"), "library gone: no such folder"),
        (("recommend", "ct.nrrd", "--library", "nothing"), "holds no picture"),
        (("recommend", "gone.nrrd", "--library", "."), "gone.nrrd"),
        (
            ("recommend", "ct.nrrd", "--library", ".", "--top", "0"),
            "--top: expected a whole number of at least 1, got 0",
        ),
        (("recommend", "ct.nrrd", "--library", ""), "argument --library: the name is empty"),
        (("recommend", "", "--library", "."), "argument INPUT: the name is empty"),
        (("colorize", "", "-r", "section.png", "-o", "o.nrrd"), "argument INPUT: the name is empty"),
        (("colorize", "ct.nrrd", "-r", "section.png", "-o", ""), "argument -o/--output: the name is empty"),
        (("batch", "", "-r", "section.png", "-o", "out"), "argument IN_FOLDER: the name is empty"),
        (("batch", ".", "-r", "section.png", "-o", ""), "argument -o/--output: the name is empty"),
        (("render", "", "-o", "o.png"), "argument VOLUME: the name is empty"),
        (("demo", "-o", ""), "argument -o/--output: the name is empty"),
        (("bench", "--seed", "-1"), "argument --seed: expected a whole number of at least 0, got -1"),
        (("library", "add", ""), "argument FOLDER: the name is empty"),
        (("demo", "-o", "notes.txt"), "demo folder notes.txt: cannot be made"),
    ],
)
def test_other_commands(folder, capfd, arguments, words):
    assert words in refused(folder, capfd, *arguments)


def test_disk_full(folder, capfd, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("nrrd.write", full)
    assert "No space left on device" in refused(
        folder, capfd, *colorize_line("ct.nrrd", "section.png", "--report", "r.json")
    )


class TestVolumes:
    @pytest.mark.parametrize(
        ("array", "message"),
        [
            (np.zeros((4, 4)), r"expected a scalar volume \(k, j, i\), got shape \(4, 4\)"),
            (np.zeros((2, 4, 4, 3)), "a colour image cannot be an input, only a reference"),
            (np.zeros((0, 4, 4)), "no voxels"),
            (np.zeros((2, 4, 4), complex), "expected integer or float voxels, got complex128"),
            (np.full((2, 2, 2), "a"), "expected integer or float voxels"),
        ],
    )
    def test_array(self, array, message):
        with pytest.raises(InputError, match=f"scan: .*{message}"):
            Volume(array, name="scan")

    @pytest.mark.parametrize(
        "matrix",
        [
            np.eye(3),
            np.full((4, 4), np.nan),
            np.diag([1.0, 1.0, 0.0, 1.0]),
            np.diag([1.0, np.inf, 1.0, 1.0]),
            np.ones((4, 4)),
        ],
    )
    def test_geometry(self, matrix):
        with pytest.raises(InputError, match="geometry"):
            Volume(np.zeros((2, 2, 2)), matrix)
        with pytest.raises(InputError, match="geometry"):
            ColorVolume(np.zeros((2, 2, 2, 3), np.uint8), matrix)

    @pytest.mark.parametrize("spacing", [1e-6, 0.01, 50, 1e6])
    def test_small_and_large_voxels_are_no_singular_geometry(self, spacing):
        volume = Volume(np.zeros((2, 2, 2)), np.diag([spacing, 1.0, spacing, 1.0]))
        np.testing.assert_allclose(volume.spacing_mm, [spacing, 1, spacing])

    def test_geometry_is_a_copy_that_cannot_be_altered(self):
        matrix = np.eye(4)
        volume = Volume(np.zeros((2, 2, 2)), matrix)
        matrix[0, 0] = 5
        assert volume.ijk_to_ras[0, 0] == 1
        with pytest.raises(ValueError, match="read-only"):
            volume.ijk_to_ras[0, 0] = 2

    @pytest.mark.parametrize(
        "rgb", [np.zeros((2, 2, 2), np.uint8), np.zeros((2, 2, 2, 4), np.uint8), np.zeros((2, 2, 2, 3))]
    )
    def test_colored(self, rgb):
        with pytest.raises(InputError, match=r"expected uint8 \(k, j, i, 3\)"):
            ColorVolume(rgb, np.eye(4))

    def test_nothing_but_air(self, ct, rng):
        noise = Volume(rng.normal(-1000, 10, (2, 40, 40)).astype(np.float32))
        try:
            result = colorize(noise, [ct.reference], Settings(preset="draft", features="embedded", device="cpu"))
        except InputError as error:
            assert "body" in str(error)
        else:
            assert result.rgb.shape == (2, 40, 40, 3)


def test_all_errors_but_the_users_own_decision_are_told_alike():
    from MedColorLib import errors

    classes = [c for c in vars(errors).values() if isinstance(c, type) and issubclass(c, Exception)]
    assert all(issubclass(c, MedColorError) for c in classes if c is not Cancelled)
    assert not issubclass(Cancelled, MedColorError)


@pytest.mark.parametrize("error", [MemoryError("9 TiB"), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
def test_memory_that_ends_anywhere_is_one_sentence(folder, capfd, monkeypatch, error):
    def ended(*_, **__):
        raise error

    monkeypatch.setattr("MedColorLib.io.files.write_color_volume", ended)
    assert (
        main(
            ["colorize", "ct.nrrd", "-r", "section.png", "--preset", "draft", "--features", "embedded", "-o", "o.nrrd"]
        )
        == 2
    )
    told = capfd.readouterr().err
    assert told.count("\n") == 1 and "memory of this machine is too small; close other programs" in told
