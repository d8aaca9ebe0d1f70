"""Judge 3D sensors from their point clouds alone.

Point clouds in; performance maps, features, measurements and view scores out. No function here knows whether a cloud
was rendered or measured, so both are judged in the same way.

``import characterisation`` gives the functions and types in :data:`__all__`, each imported when it is first used.
``docs/reference/interface.md`` lists what is promised; all other modules may change from one version to the next.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

#: name -> module that defines it
_NAMES = {
    "Coupon": "characterisation.coupon.patches",
    "Cylinder": "characterisation.features.surfaces",
    "CylinderFit": "characterisation.features.fitted",
    "FitError": "characterisation.features.robust_fit",
    "InputError": "characterisation.files.errors",
    "MissingEnvironmentError": "characterisation.files.errors",
    "Overall": "characterisation.coupon.patch_table",
    "PerformanceMap": "characterisation.maps.performance_map",
    "PlaneFit": "characterisation.features.fitted",
    "PointCloud": "characterisation.point_cloud",
    "SphereFit": "characterisation.features.fitted",
    "Status": "characterisation.point_cloud",
    "ViewGrid": "characterisation.point_cloud",
    "deciles": "characterisation.scores.deciles",
    "fit_cylinder": "characterisation.features.fits",
    "fit_plane": "characterisation.features.fits",
    "fit_sphere": "characterisation.features.fits",
    "measure_coupon": "characterisation.coupon_cloud",
    "overall": "characterisation.coupon.patch_table",
    "patch_metrics": "characterisation.coupon_cloud",
    "read_cloud": "characterisation.cloud_files",
    "write_cloud": "characterisation.cloud_files",
}

if TYPE_CHECKING:
    from characterisation.cloud_files import read_cloud as read_cloud
    from characterisation.cloud_files import write_cloud as write_cloud
    from characterisation.coupon.patch_table import Overall as Overall
    from characterisation.coupon.patch_table import overall as overall
    from characterisation.coupon.patches import Coupon as Coupon
    from characterisation.coupon_cloud import measure_coupon as measure_coupon
    from characterisation.coupon_cloud import patch_metrics as patch_metrics
    from characterisation.features.fits import fit_cylinder as fit_cylinder
    from characterisation.features.fits import fit_plane as fit_plane
    from characterisation.features.fits import fit_sphere as fit_sphere
    from characterisation.features.fitted import CylinderFit as CylinderFit
    from characterisation.features.fitted import PlaneFit as PlaneFit
    from characterisation.features.fitted import SphereFit as SphereFit
    from characterisation.features.robust_fit import FitError as FitError
    from characterisation.features.surfaces import Cylinder as Cylinder
    from characterisation.files.errors import InputError as InputError
    from characterisation.files.errors import MissingEnvironmentError as MissingEnvironmentError
    from characterisation.maps.performance_map import PerformanceMap as PerformanceMap
    from characterisation.point_cloud import PointCloud as PointCloud
    from characterisation.point_cloud import Status as Status
    from characterisation.point_cloud import ViewGrid as ViewGrid
    from characterisation.scores.deciles import deciles as deciles

__all__ = list(_NAMES)


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    if name not in _NAMES:
        raise AttributeError(f"module 'characterisation' has no attribute {name!r}")
    member = globals()[name] = getattr(import_module(_NAMES[name]), name)
    return member


def __dir__() -> list[str]:
    """List the public names and the module's own."""
    return sorted({*globals(), *__all__})
