"""Define the settings of a DepthAI camera, and record the resulting stereo configuration.

Signal chain: settings -> ``StereoDepthConfig`` with every filter off -> all of its switches, recorded.

DepthAI 3 fills holes and smooths disparities by default (``postProcessing.holeFilling`` and ``adaptiveMedianFilter``).
F and sigma would then be those of the filters. The device may compute depth with the design baseline or the calibrated
one; on one unit they differ by 2.6 % (depthai-core, issues 358 and 847). The disparity is therefore used, and the three
switches for the design baseline are off.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from characterisation.files.documents import Document

#: sizes that the device itself derives from the OV9282, by cropping (720 rows, 480 rows) and binning (640 columns)
SIZES = ((1280, 800), (1280, 720), (640, 480), (640, 400))

#: post-processing filters, switched off by ``enable``
_FILTERS = ("holeFilling", "adaptiveMedianFilter", "spatialFilter", "temporalFilter", "speckleFilter")


class DepthaiSettings(Document):
    """Settings applied before captures are taken.

    - ``exposure_s``: fixed, with ``sensitivity_iso``; by default the device's own control, which campaigns reject.
    - ``size_px``: columns and rows.
    - ``dot_projector`` and ``flood_light``: shares of full intensity.
    - ``preset`` of the matcher, then ``subpixel_bits`` of its disparities, ``left_right_check`` and its threshold [px],
      ``confidence_threshold`` and ``extended`` disparities.
    - ``disparity``: run the device's matcher in addition to the images.
    - ``warm_up_frames``: number of frames discarded after the start (default assumed).
    - ``timeout_s`` of a capture.
    """

    exposure_s: Annotated[float, Field(ge=1e-6, le=0.5)] | None = None
    sensitivity_iso: int = Field(default=200, ge=100, le=1600)
    size_px: tuple[int, int] = (1280, 800)
    frames_per_second: Annotated[float, Field(gt=0, le=120)] = 10.0
    dot_projector: Annotated[float, Field(ge=0, le=1)] = 0.7
    flood_light: Annotated[float, Field(ge=0, le=1)] = 0.0
    disparity: bool = True
    preset: Literal["DEFAULT", "ACCURACY", "DENSITY", "ROBOTICS", "HIGH_DETAIL"] = "ACCURACY"
    subpixel_bits: Literal[3, 4, 5] = 5
    left_right_check: bool = True
    left_right_threshold: int = Field(default=10, ge=0, le=255)
    confidence_threshold: int = Field(default=55, ge=0, le=255)
    extended: bool = False
    warm_up_frames: int = Field(default=10, ge=0, le=1000)
    timeout_s: Annotated[float, Field(gt=0, le=600)] = 5.0

    @model_validator(mode="after")
    def _possible(self) -> DepthaiSettings:
        if self.size_px not in SIZES:
            raise ValueError("size_px of " + ", ".join(f"[{width}, {height}]" for width, height in SIZES))
        if self.exposure_s is not None and self.exposure_s * self.frames_per_second > 1:
            raise ValueError("an exposure_s within the frame time: lower frames_per_second")
        return self


def configure(config: Any, settings: DepthaiSettings, dai: Any) -> None:
    """Configure a ``StereoDepthConfig``: the matcher by the settings, every filter off."""
    config.setSubpixel(True)
    config.setSubpixelFractionalBits(settings.subpixel_bits)
    config.setLeftRightCheck(settings.left_right_check)
    config.setLeftRightCheckThreshold(settings.left_right_threshold)
    config.setConfidenceThreshold(settings.confidence_threshold)
    config.setExtendedDisparity(settings.extended)
    config.setMedianFilter(dai.filters.params.MedianFilter.MEDIAN_OFF)
    post = config.postProcessing
    for name in _FILTERS:
        getattr(post, name).enable = False
    post.bilateralSigmaValue = 0
    post.decimationFilter.decimationFactor = 1
    post.thresholdFilter.minRange, post.thresholdFilter.maxRange = 0, 65535
    post.brightnessFilter.minBrightness, post.brightnessFilter.maxBrightness = 0, 256


def configuration(config: Any) -> dict[str, Any]:
    """Return every switch of a ``StereoDepthConfig`` that changes F or sigma, as plain JSON values."""
    post = config.postProcessing
    return {
        "subpixel_bits": config.getSubpixelFractionalBits() if config.getSubpixel() else 0,
        "left_right_check": config.getLeftRightCheck(),
        "left_right_threshold": config.getLeftRightCheckThreshold(),
        "confidence_threshold": config.getConfidenceThreshold(),
        "extended": config.getExtendedDisparity(),
        "companding": config.costMatching.enableCompanding,
        "median_filter": str(config.getMedianFilter().name),
        "filters": {name: bool(getattr(post, name).enable) for name in _FILTERS},
        "bilateral_sigma": post.bilateralSigmaValue,
        "decimation": post.decimationFilter.decimationFactor,
        "threshold_mm": [post.thresholdFilter.minRange, post.thresholdFilter.maxRange],
        "brightness_dn": [post.brightnessFilter.minBrightness, post.brightnessFilter.maxBrightness],
    }
