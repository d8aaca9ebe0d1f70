"""Send rendered pairs to the matcher of a connected DepthAI device: the maker's own decoder on simulated images.

The tests use the real package's frames and queues; the pipeline needs a device and has not been run on one.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.capture.devices.depthai_camera import (
    Image,
    aligned,
    configure_matcher,
    depthai,
    disparity_of,
    fault_of,
    pixels,
)
from mitsim.capture.devices.depthai_settings import DepthaiSettings


def match_on_device(
    left: Image,
    right: Image,
    settings: DepthaiSettings,
    identifier: str = "",
    rectified: bool = True,
    package: Any = None,
) -> NDArray[np.float32]:
    """Return the disparity (H, W) [px] that a connected device's own matcher finds in a pair of images.

    Parameters
    ----------
    left, right
        (H, W) uint8.
    settings
        Settings of the matcher.
    identifier
        Identifier of the device; by default the first that is found.
    rectified
        Whether the pair is rectified already. If not, the device rectifies it with its stored calibration, so a
        rendered pair must use that calibration: :func:`mitsim.capture.devices.maker_captures.depthai_rig`.
    package
        The package ``depthai``; imported by default.

    Raises
    ------
    DeviceError
        If there is no such device, or it returns nothing in time.

    See Also
    --------
    grey_frame : makes the images that it sends
    """
    dai, where = package or depthai(), f"camera depthai{':' + identifier if identifier else ''}"
    device = pipeline = None
    try:
        device = dai.Device(dai.DeviceInfo(identifier)) if identifier else dai.Device()
        pipeline = dai.Pipeline(device)
        stereo = pipeline.create(dai.node.StereoDepth)
        stereo.setDefaultProfilePreset(getattr(dai.node.StereoDepth.PresetMode, settings.preset))
        configure_matcher(stereo, settings, dai)
        stereo.setRectification(not rectified)
        stereo.setInputResolution(left.shape[1], left.shape[0])
        inputs = [stereo.left.createInputQueue(), stereo.right.createInputQueue()]
        out = {"disparity": stereo.disparity.createOutputQueue()}
        pipeline.start()
        sockets = (dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C)
        for queue, image, socket in zip(inputs, (left, right), sockets, strict=True):
            queue.send(grey_frame(image, socket, dai))
        frame = aligned(out, settings.timeout_s, where)["disparity"]
        return disparity_of(pixels(frame), settings.subpixel_bits)
    except Exception as error:
        raise fault_of(error, dai, where, "match") from error
    finally:
        for close in (pipeline and pipeline.stop, device and device.close):
            if close:
                with suppress(Exception):
                    close()


def grey_frame(image: Image, socket: Any, dai: Any, number: int = 0) -> Any:
    """Make an ``ImgFrame`` of a grey image.

    Parameters
    ----------
    image
        (H, W) uint8.
    socket
        Socket of the camera that the image is from.
    dai
        The package ``depthai``.
    number
        Sequence number of the frame.
    """
    frame = dai.ImgFrame()
    frame.setType(dai.ImgFrame.Type.GRAY8)
    frame.setWidth(image.shape[1])
    frame.setHeight(image.shape[0])
    frame.setData(np.ascontiguousarray(image, np.uint8).ravel())
    frame.setInstanceNum(int(socket.value))
    frame.setSequenceNum(number)
    return frame
