"""TIFF files of several pages: a stack of images, or refused where one image is meant.

Before, the first page was taken without a word, and a stack of a rig was refused as one image of many.
"""

from __future__ import annotations

import struct

import cv2
import numpy as np
import PIL.Image
import pytest

from characterisation.files.errors import InputError
from mitsim.capture.grey_image import page_count, read_grey, read_pages
from mitsim.capture.recordings.depth_image import read_depth_image
from mitsim.capture.recordings.image_folder import at_size_of_images, read_image_folder
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.capture.recordings.stereo_pair import read_stereo_pair
from tests.capture.recordings.test_image_folder import rig, save, see_plane

CALIBRATION = (
    '{"K1": [[80, 0, 31.5], [0, 80, 23.5], [0, 0, 1]], "K2": [[80, 0, 31.5], [0, 80, 23.5], [0, 0, 1]], '
    '"R": [0, 0, 0], "T": [-60, 0, 0]}'
)


def pages_of(count, kind=np.uint16):
    levels = np.arange(48 * 64).reshape(48, 64) % 200
    return np.stack([levels + 10 * number for number in range(count)]).astype(kind)


def stacked(path, images, big=False):
    first, *others = [PIL.Image.fromarray(image) for image in images]
    first.save(path, save_all=True, append_images=others, big_tiff=big)
    return path


def test_a_stack_of_a_rig_is_that_of_single_files(tmp_path):
    """One file of all images, or one file of each, or some of both, in the order of their numbers."""
    sensor = rig(tmp_path)
    images = see_plane(sensor)
    (tmp_path / "some").mkdir()
    save(tmp_path / "some", images[:3])
    stacked(tmp_path / "some/image_3.tif", images[3:-1])
    cv2.imwrite(str(tmp_path / "some/image_10.png"), images[-1])
    (tmp_path / "all").mkdir()
    stacked(tmp_path / "all/stack.tif", images)
    for folder in ("some", "all"):
        capture = read_image_folder(tmp_path / folder, sensor)
        np.testing.assert_array_equal(capture.images["camera"], images)
        assert at_size_of_images(tmp_path / folder, lambda size: size) == (64, 48)
    assert capture.settings["files"]["camera"][1] == f"stack.tif, page 2 of {len(images)}"


def test_a_stack_with_a_page_too_few_or_of_another_size_is_refused(tmp_path):
    sensor = rig(tmp_path)
    images = see_plane(sensor)
    (tmp_path / "images").mkdir()
    stacked(tmp_path / "images/stack.tif", images[:-1])
    with pytest.raises(InputError, match=f"images of camera: found {len(images) - 1}, stack.tif"):
        read_image_folder(tmp_path / "images", sensor)
    stacked(tmp_path / "images/stack.tif", [*images[:-1], images[-1][:40]])
    with pytest.raises(InputError, match=f"stack.tif, page {len(images)} of {len(images)}: size: found 64 x 40 px"):
        read_image_folder(tmp_path / "images", sensor)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_pages_keep_their_levels_and_their_order(tmp_path, kind, big):
    path = stacked(tmp_path / "a.tif", pages_of(4, kind), big)
    np.testing.assert_array_equal(list(read_pages(path)), pages_of(4, kind))


def test_one_image_of_several_pages_is_refused_where_one_is_meant(tmp_path):
    path = stacked(tmp_path / "depth.tif", 500 + pages_of(3))
    (tmp_path / "a.json").write_text(CALIBRATION)
    with pytest.raises(InputError, match=r"depth.tif: pages: found 3 pages; allowed: one image"):
        read_grey(path)
    with pytest.raises(InputError, match=r"depth.tif: pages: found 3 pages; allowed: one image"):
        read_depth_image(path, ReadOptions(calibration=tmp_path / "a.json"))
    (tmp_path / "pair").mkdir()
    for name in ("left", "right"):
        stacked(tmp_path / f"pair/{name}.tif", pages_of(2, np.uint8))
    with pytest.raises(InputError, match=r"left.tif: pages: found 2 pages; allowed: one image"):
        read_stereo_pair(tmp_path / "pair", ReadOptions(calibration=tmp_path / "a.json"))


@pytest.mark.parametrize(("kind", "place"), [(1, 0), (1, 1), (4, 1)])
def test_a_reduced_copy_or_a_mask_is_no_page(tmp_path, kind, place):
    cv2.imwritemulti(str(tmp_path / "a.tif"), list(pages_of(2)))
    parts = (tmp_path / "a.tif").read_bytes().split(struct.pack("<HHII", 254, 4, 1, 2))
    assert len(parts) == 3
    marks = [struct.pack("<HHII", 254, 4, 1, kind if number == place else 0) for number in range(2)]
    (tmp_path / "a.tif").write_bytes(parts[0] + marks[0] + parts[1] + marks[1] + parts[2])
    assert page_count(tmp_path / "a.tif") == 1
    np.testing.assert_array_equal(read_grey(tmp_path / "a.tif"), pages_of(2)[1 - place])


@pytest.mark.parametrize("field", ["page", "entries", "following page"])
def test_an_offset_beyond_any_file_is_refused(tmp_path, field):
    """Before, an OverflowError."""
    path = stacked(tmp_path / "a.tif", pages_of(1), big=True)
    data = path.read_bytes()
    (first,) = struct.unpack_from("<Q", data, 8)
    (entries,) = struct.unpack_from("<Q", data, first)
    at = {"page": 8, "entries": first, "following page": first + 8 + 20 * entries}[field]
    path.write_bytes(data[:at] + bytes([0xFF] * 8) + data[at + 8 :])
    with pytest.raises(InputError, match="a TIFF cut off in page"):
        page_count(path)


def test_a_damaged_stack_is_refused_or_read_whole(tmp_path):
    """Cut off anywhere, or with any byte of a directory changed: never fewer pages in silence, nor a traceback."""
    path = stacked(tmp_path / "a.tif", pages_of(3)[:, :6, :8])
    data, whole = path.read_bytes(), []
    for end in range(4, len(data), 7):
        path.write_bytes(data[:end])
        try:
            np.testing.assert_array_equal(list(read_pages(path)), pages_of(3)[:, :6, :8])
            whole.append(end)
        except InputError as error:
            assert "a.tif" in str(error)
    assert all(end > len(data) - 8 for end in whole)  # without the last bytes, which fill up
    (first,) = struct.unpack_from("<I", data, 4)
    (entries,) = struct.unpack_from("<H", data, first)
    path.write_bytes(data[: first + 2 + 12 * entries] + struct.pack("<I", first) + data[first + 6 + 12 * entries :])
    with pytest.raises(InputError, match="pages in a ring"):
        page_count(path)
    for at in range(first, first + 6 + 12 * entries):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        try:
            list(read_pages(path))
        except InputError as error:
            assert "a.tif" in str(error)
