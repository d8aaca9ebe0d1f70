"""Compute the irradiance of a room on the part within the sensor's optical filter, and the exposures that suit it.

Signal chain: illuminance [lx] -> shares of white LED lamps and of daylight -> spectral irradiance -> integral over the
band of the sensor's optical filter -> exposures, shorter than those of the sensor's rule where the room is bright.

Both spectra are models:

- A lamp emits evenly over 430 to 680 nm, with 320 lm per watt of radiation, as phosphor-converted white LEDs do.
- Daylight is a black body at 6500 K, the correlated colour temperature of CIE illuminant D65.

V(lambda) is 1.019 exp(-285.4 (lambda - 0.559 um)^2), the usual approximation of the CIE curve. Not modelled: window
glass, which absorbs part of the infrared, and the imager's spectral response within the band.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.sensor import Sensor

#: share of full scale that a matt white plate reaches at most by light of the room. It is chosen: the remainder is for
#: slopes toward the light, interreflections and fixed pattern
FULLEST = 0.9

#: reflectance of a matt white plate, as in the exposure rules of the presets
_WHITE = 0.85

#: spectral range of silicon without a filter [nm]
SILICON_NM = (400.0, 1000.0)

#: band over which the model of a white LED emits evenly [nm]
LED_NM = (430.0, 680.0)

#: luminous efficacy of radiation of a phosphor-converted white LED [lm/W]
LED_LM_PER_W = 320.0

#: colour temperature of daylight [K]
DAYLIGHT_K = 6500.0

#: maximum luminous efficacy of radiation [lm/W], defined by the SI
_KM = 683.002

#: h c / k [nm K]
_SECOND_RADIATION_CONSTANT = 1.438776877e7

_WAVELENGTHS = np.arange(360.0, 1101.0, 1.0)


def room_irradiance(illuminance: float, daylight: float, wavelength_nm: float, filter_nm: float = 0.0) -> float:
    """Return the irradiance of a room within a sensor's band [W/mm^2].

    Parameters
    ----------
    illuminance, daylight
        Illuminance [lx], and the share of it that comes from the sky [1].
    wavelength_nm, filter_nm
        Middle and full width of the band; 0 for the whole range of silicon.
    """
    low, high = SILICON_NM
    if filter_nm > 0:
        low, high = max(low, wavelength_nm - filter_nm / 2), min(high, wavelength_nm + filter_nm / 2)
    shared = max(0.0, min(high, LED_NM[1]) - max(low, LED_NM[0])) / (LED_NM[1] - LED_NM[0])
    lamps = (1 - daylight) * illuminance / LED_LM_PER_W * shared
    sky = _black_body(_WAVELENGTHS)
    luminous = _KM * np.trapezoid(sky * _photopic(_WAVELENGTHS), _WAVELENGTHS)
    band = np.linspace(low, high, 200)
    windows = daylight * illuminance * np.trapezoid(_black_body(band), band) / luminous
    return float(lamps + windows) * 1e-6


def exposures_in_room(
    sensor: Sensor, exposures_s: tuple[float, ...], distance_mm: float, irradiance: float
) -> tuple[float, ...]:
    """Return the exposures [s] that a user sets in a room, for a part at a distance.

    They are those of the sensor's rule, which knows no room, times the largest factor up to 1 with which a matt white
    plate at normal incidence shows the bright pattern and the room at :data:`FULLEST` of full scale. A plate that is
    brighter in the dark stays as bright. For time of flight, full scale is a full tap.

    Parameters
    ----------
    sensor, exposures_s
        A sensor with known light, and the exposures of its rule, the shortest first.
    distance_mm
        Of the plate from the projector [mm].
    irradiance
        Of the room within the sensor's band [W/mm^2], as of :func:`room_irradiance`.
    """
    by_radiance = sensor.electrons() * exposures_s[0] / sensor.imager.full_well
    control = sensor.exposure.control
    plate, room = sensor.projector.plate_radiance(_WHITE, distance_mm), _WHITE / np.pi * irradiance
    if isinstance(sensor.pattern, AmplitudeModulation):  # of the two taps of a pixel the fuller one
        plate, room = plate * (1 + float(sensor.pattern.contrasts.max())) / 2, room / 2
    dark = plate * by_radiance if control is None else control.level
    both = dark + room * by_radiance
    factor = min(1.0, max(FULLEST, dark) / both)
    return tuple(factor * seconds for seconds in exposures_s)


def _black_body(wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Planck's spectrum in arbitrary units; only its shape matters here."""
    return np.asarray(
        (wavelength_nm / 560.0) ** -5 / np.expm1(_SECOND_RADIATION_CONSTANT / (wavelength_nm * DAYLIGHT_K))
    )


def _photopic(wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(1.019 * np.exp(-285.4 * (wavelength_nm * 1e-3 - 0.559) ** 2))
