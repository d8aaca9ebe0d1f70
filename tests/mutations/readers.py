"""What is read of users, by class: a sound file of each, and what a command makes of it."""

import contextlib
import io
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SCENES = ROOT / "scenes"
PRESETS = ROOT / "mitsim" / "sensor" / "presets"


@dataclass(frozen=True)
class Reader:
    """``sound`` makes the file, or a folder of them of which ``file`` is changed; ``read`` takes its path."""

    sound: Callable[[Path], Path]
    read: Callable[[Path], object]
    dataset: bool = False


def command(*arguments):
    """A command in this process; exit codes of a bug of ours are none."""
    from mitsim.cli.program import main

    before, sys.argv = sys.argv, ["mitsim", *map(str, arguments)]
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as told:
            main()
    except SystemExit as done:
        if done.code == 2:
            from characterisation.files.errors import InputError

            raise InputError("command", "", told.getvalue()[-200:], "") from None
        if done.code not in (0, 1, 3):
            raise RuntimeError(f"exit code {done.code}: {told.getvalue()[-300:]}") from None
    finally:
        sys.argv = before


def copied(source):
    def make(folder):
        path = folder / source.name
        path.write_bytes(source.read_bytes())
        return path

    return make


def _sensor(path):
    from mitsim.sensor.preset import load_sensor

    load_sensor(path)


def _rig(path):
    from mitsim.sensor.preset import load_sensor

    load_sensor(path, "decoding")


def _task(path):
    from characterisation.tasks.task_reading import read_task

    read_task(path)


def _study(folder):
    task = (SCENES / "two_pillars" / "task.toml").as_posix()
    scene = (SCENES / "two_pillars" / "matt_white.xml").as_posix()
    text = (SCENES / "two_pillars" / "study.toml").read_text(encoding="utf-8")
    text = text.replace('"two_pillars.xml"', f'"{scene}"').replace('"task.toml"', f'"{task}"')
    path = folder / "study.toml"
    path.write_text(text.replace("[characterisation]", "[characterisation]\n#"), encoding="utf-8")
    return path


def _read_study(path):
    from characterisation.files.documents import read_toml
    from mitsim.study import StudyFile

    read_toml(path, StudyFile)


def _read_campaign(path):
    from characterisation.files.documents import read_toml
    from mitsim.maps.campaign.campaign_file import CampaignFile

    read_toml(path, CampaignFile)


def _scene(path):
    from mitsim.scene.load import load_scene

    load_scene(path, 850.0)


def _map(path):
    from characterisation.maps.performance_map import PerformanceMap

    found = PerformanceMap.load(path)
    normals = np.array([[0.0, 0.0, 1.0], [0.28, 0.0, 0.96]])
    for finish, roughness in found.samples:
        found.query(finish, roughness, [500.0, 600.0], normals)


def _run_folder(name):
    def make(folder):
        from tests.report.conftest import write_run

        return write_run(folder / "run") / name

    return make


def _read_run(path):
    from mitsim.report.agreement import agreement
    from mitsim.study.run_folder import read_run

    folder = path.parent if path.parent.name != "view_0004" else path.parents[2]
    run = read_run(folder)
    for view in run.checked[:1]:
        run.predicted(view), run.decoded(view), run.capture(view)
    for name in run.measurements:
        agreement(run.scores, run.checks, name)


def _report(path):
    command("report", path.parent)


def _cloud(folder):
    from characterisation.cloud_files import write_cloud
    from tests.report.conftest import cloud

    write_cloud(cloud("simulated", 1), folder / "cloud.ply")
    return folder / "cloud.ply"


def _read_cloud(path):
    from characterisation.cloud_files import read_cloud

    read_cloud(path)


def _foreign(folder):
    rows = np.random.default_rng(1).uniform(-50, 50, (60, 3))
    head = "ply\nformat ascii 1.0\nobj_info num_cols 10\nobj_info num_rows 6\nelement vertex 60\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    path = folder / "foreign.ply"
    path.write_text(head + "\n".join(" ".join(f"{x:.3f}" for x in row) for row in rows) + "\n", encoding="ascii")
    return path


def _decode_foreign(path):
    from mitsim.capture.recordings.ply import decode_ply

    decode_ply(path.read_bytes(), path)


def _image(folder):
    from mitsim.sensor.png import encode_png

    path = folder / "image.png"
    path.write_bytes(encode_png(np.random.default_rng(1).integers(0, 255, (40, 60)).astype(np.uint8)))
    return path


def _read_image(path):
    from mitsim.capture.grey_image import read_grey

    read_grey(path)


def _read_projector_image(path):
    from mitsim.sensor.projector_images import read_images

    read_images(path.parent, 60, 40)


def _opencv(suffix):
    def make(folder):
        import cv2

        path = folder / f"calibration{suffix}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for name, value in _CALIBRATION.items():
            storage.write(name, value)
        storage.release()
        return path

    return make


def _ros(folder):
    path = folder / "calibration.yaml"
    matrix = "  rows: 3\n  cols: 3\n  data: [600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0]\n"
    path.write_text(
        "image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\nbinning_x: 2\nbinning_y: 2\n"
        f"camera_matrix:\n{matrix}roi:\n  x_offset: 64\n  y_offset: 40\n  width: 320\n  height: 240\n"
        "distortion_coefficients:\n- -0.1\n- 0.01\n- 0.0\n- 0.0\n- 0.0\n",
        encoding="utf-8",
    )
    return path


def _kalibr(folder):
    path = folder / "camchain.yaml"
    camera = "  camera_model: pinhole\n  intrinsics: [600.0, 601.2, 322.3, 241.7]\n  resolution: [640, 480]\n"
    camera += "  distortion_model: radtan\n  distortion_coeffs: [-0.1, 0.01, 0.0, 0.0]\n"
    step = "  T_cn_cnm1:\n  - [1.0, 0.0, 0.0, -0.06]\n  - [0.0, 1.0, 0.0, 0.0]\n  - [0.0, 0.0, 1.0, 0.0]\n"
    path.write_text(f"cam0:\n{camera}cam1:\n{camera}{step}  - [0.0, 0.0, 0.0, 1.0]\n", encoding="utf-8")
    return path


def _orb_slam(folder):
    from tests.sensor.test_calibrated_poses import BENT, FIRST_FROM_SECOND, orb_slam

    path = folder / "settings.yaml"
    path.write_text(orb_slam("PinHole", BENT, ("k1", "k2", "p1", "p2"), FIRST_FROM_SECOND), encoding="utf-8")
    return path


def _mc_calib(folder):
    from tests.sensor.test_calibrated_poses import ROUND, mc_calib

    return mc_calib(folder, 1, ROUND)


def _quaternion(folder):
    from tests.sensor.test_calibrated_poses import QUATERNIONS, posed, xyz

    cameras, quaternion, shift = posed(QUATERNIONS["quaternion"], metres=1.0)
    path = folder / "quaternion.json"
    path.write_text(json.dumps(cameras | {"quaternion": quaternion, "translation": xyz(shift)}), encoding="utf-8")
    return path


def _pose_of_ros(folder):
    path = folder / "pose.yaml"
    place, turn = "x: 0.1\n  y: -0.02\n  z: 0.5\n", "x: 0.0\n  y: 0.6\n  z: 0.0\n  w: 0.8\n"
    path.write_text(f"position:\n  {place}orientation:\n  {turn}", encoding="utf-8")
    return path


def _read_pose_option(path):
    from mitsim.capture.recordings.pose_file import read_pose

    read_pose(path)


def _stack_of_pages(folder):
    import cv2

    cv2.imwritemulti(str(folder / "stack.tif"), [np.full((6, 8), level, np.uint16) for level in (100, 200, 300)])
    return folder / "stack.tif"


def _read_stack(path):
    from mitsim.capture.grey_image import page_count, read_pages

    page_count(path)
    list(read_pages(path))


def _toolbox(folder):
    from scipy.io import savemat

    camera = {"K": np.array([[600.0, 0, 321], [0, 600, 241], [0, 0, 1]]), "RadialDistortion": [0.1, 0.0]}
    camera |= {"TangentialDistortion": [0.0, 0.0], "ImageSize": [480.0, 640.0], "WorldUnits": "millimeters"}
    pose = np.eye(4)
    pose[0, 3] = -60
    pair = {"CameraParameters1": camera, "CameraParameters2": camera, "PoseCamera2": {"A": pose}}
    savemat(folder / "stereo.mat", {"s": pair})
    return folder / "stereo.mat"


def _read_cameras(path):
    from mitsim.capture.recordings.calibration_file import read_calibration

    read_calibration(path, (160, 120))


def _maps_of_cameras(name):
    """Two cameras in maps of unlike form, a projector, and a pose."""

    def make(folder):
        camera = {"intrinsics": {"fx": 600.0, "fy": 601.0, "ppx": 80.0, "ppy": 60.0}, "distortion": {"k1": -0.1}}
        other = {"camera_matrix": [600.0, 0, 80, 0, 600, 60, 0, 0, 1], "dist_coeffs": [-0.1, 0.1, 0, 0, 0]}
        pose = {"R": np.eye(3).tolist(), "T": [-60.0, 0.0, 0.0]}
        projector = {"K": {"rows": 3, "cols": 3, "dt": "d", "data": [900, 0, 80, 0, 900, 60, 0, 0, 1]}}
        table = {
            "left": camera,
            "right": other | pose,
            "projector": projector,
            "resolution": {"width": 160, "height": 120},
        }
        path = folder / name
        if name.endswith(".json"):
            path.write_text(json.dumps(table, indent=1), encoding="utf-8")
        else:
            import yaml

            path.write_text(yaml.dump(table), encoding="utf-8")
        return path

    return make


#: calibrations in forms of their own, by the names of their files
_FORMS = {
    "cameras.txt": "# comment\n1 RADIAL 160 120 600 80 60 -0.1 0.1\n2 OPENCV_FISHEYE 160 120 600 601 80 60 0.1 0 0 0\n",
    "middlebury.txt": "cam0=[600 0 80; 0 600 60; 0 0 1]\ncam1=[600 0 82; 0 600 60; 0 0 1]\ndoffs=2\nbaseline=193\n"
    "width=160\nheight=120\nndisp=20\n",
    "kitti.txt": "calib_time: 09-Jan-2012\n"
    + "".join(
        f"S_{at}: 1.6e+02 1.2e+02\nK_{at}: 600 0 80 0 600 60 0 0 1\nD_{at}: -0.1 0.1 0 0 0\nR_{at}: 1 0 0 0 1 0 0 0 1\n"
        f"T_{at}: -0.{at} 0 0\nS_rect_{at}: 150 110\nP_rect_{at}: 600 0 80 -{at} 0 600 60 0 0 0 1 0\n"
        for at in ("00", "01")
    ),
    "SN1.conf": "".join(
        f"[{side}_CAM_{ending}]\nfx=600\nfy=600\ncx=80\ncy=60\nk1=-0.1\nk2=0.1\np1=0\np2=0\nk3=0\n"
        for side in ("LEFT", "RIGHT")
        for ending in ("HD", "VGA")
    )
    + "[STEREO]\nBaseline=120\nTY=0.1\nTZ=0.1\nCV_HD=0.01\nRX_HD=0\nRZ_HD=0\nCV_VGA=0.01\nRX_VGA=0\nRZ_VGA=0\n",
    "metashape.xml": "<calibration><projection>frame</projection><width>160</width><height>120</height><f>600</f>"
    "<cx>1</cx><cy>2</cy><b1>1</b1><k1>-0.1</k1><p1>0.001</p1></calibration>",
    "kinect.json": json.dumps(
        {
            "CalibrationInformation": {
                "Cameras": [
                    {
                        "Intrinsics": {
                            "ModelParameters": [0.5, 0.5, 0.5, 0.5, 0.1, 0, 0, 0.1, 0, 0, 0, 0, 0, 0],
                            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
                        },
                        "Purpose": "CALIBRATION_CameraPurposeDepth",
                        "SensorHeight": 1024,
                        "SensorWidth": 1024,
                    }
                ]
            }
        }
    ),
    "a.cameramodel": "# note\n{ 'lensmodel': 'LENSMODEL_OPENCV4', 'intrinsics': [ 600, 601, 80, 60, -0.1, 0, 0, 0,],\n"
    "'extrinsics': [ 0, 0.1, 0, 5, 6, 7,], 'imagersize': [ 160, 120 ],\n'optimization_inputs': b'a%&' }\n",
}

#: the sizes of images of which these forms have cameras [px], others than 160 x 120
_SIZES = {"SN1.conf": (672, 376), "kinect.json": (640, 576), "kitti.txt": (150, 110)}


def _form(name):
    def make(folder):
        (folder / name).write_text(_FORMS[name], encoding="utf-8")
        return folder / name

    return make


def _read_form(path):
    from mitsim.capture.recordings.calibration_file import read_calibration

    read_calibration(path, _SIZES.get(path.name, (160, 120)))


_CALIBRATION = {
    "K1": np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]),
    "D1": np.zeros(5),
    "R": np.eye(3),
    "T": np.array([100.0, 0, 0]),
    "image_size": np.array([640.0, 480.0]),
}


def _matlab(folder):
    from scipy.io import savemat

    savemat(folder / "calibration.mat", _CALIBRATION)
    return folder / "calibration.mat"


def _npz(folder):
    np.savez(folder / "calibration.npz", **_CALIBRATION)
    return folder / "calibration.npz"


def _read_calibration(path):
    from mitsim.sensor.calibration_tree import read_tree

    read_tree([path])


def _heights(suffix):
    def make(folder):
        z = np.random.default_rng(1).normal(0, 1, (70, 70))
        path = folder / f"heights{suffix}"
        if suffix == ".npy":
            np.save(path, z)
        else:
            np.savetxt(path, z, delimiter=",", fmt="%.3f")
        return path

    return make


def _read_heights(path):
    from mitsim.scene.surface.measured import read_height_map

    read_height_map(path, 1.0)


def _profile(folder):
    z = np.random.default_rng(1).normal(0, 1, 300)
    path = folder / "profile.csv"
    path.write_text("x_um,z_um\n" + "\n".join(f"{k},{one:.4f}" for k, one in enumerate(z)), encoding="utf-8")
    return path


def _read_profile(path):
    from mitsim.scene.surface.measured import read_profile

    read_profile(path)


def _mesh(suffix):
    def make(folder):
        import trimesh

        path = folder / f"part{suffix}"
        trimesh.creation.box((20, 30, 10)).export(path)
        return path

    return make


def _read_mesh(path):
    from mitsim.scene.authoring.read_mesh import read_mesh
    from mitsim.scene.authoring.segment_mesh import segment_mesh

    mesh = read_mesh(path)
    segment_mesh(mesh.vertices, mesh.triangles, where=str(path))


def _pose(folder):
    path = folder / "pose.json"
    path.write_text(json.dumps({"world_from_sensor": np.eye(4).tolist()}), encoding="utf-8")
    return path


def _read_pose(path):
    from mitsim.study.task_measurement import read_pose

    read_pose(path)


def _capture(path):
    from mitsim.capture.folder import read_capture

    read_capture(path.parent)


def _patches(folder):
    from mitsim.maps.campaign.campaign_file import CampaignFile
    from mitsim.maps.campaign.plan import plan_campaign
    from mitsim.maps.campaign.run import run_campaign
    from mitsim.sensor.preset import load_sensor
    from tests.maps.campaign.known_clouds import known_source, smooth

    table = {
        "distances_mm": [500],
        "orientations": [{"up_to_deg": 10, "subdivisions": 0}],
        "samples": [{"scene": "matt_white.xml"}],
        "samples_per_pixel": 1,
    }
    file = CampaignFile.model_validate(table)
    run_campaign(
        plan_campaign(SCENES / "coupon" / "campaign.toml", file, load_sensor("ensenso-n10")),
        known_source(smooth),
        folder,
    )
    return next(folder.rglob("patches.npy"))


def _read_patches(path):
    """As if the index beside it had been signed again."""
    from characterisation.coupon.patch_table import overall
    from mitsim.maps.campaign.run import joined
    from mitsim.maps.campaign.store import _table

    table = _table(path.read_bytes(), path)
    overall(table), joined([table, table])


def _read_scene_geometry(path):
    from mitsim.study.scene_geometry import read_scene_geometry

    read_scene_geometry(path.parent)


def _kept_task(folder):
    """The copy of its task in the folder of a run."""
    from characterisation.tasks.task_reading import read_task

    path = _run_folder("run.json")(folder).parent / "task.json"
    task = read_task(SCENES / "two_pillars" / "task.toml")
    path.write_text(json.dumps(task.model_dump(mode="json", exclude_unset=True, exclude_none=True)), encoding="utf-8")
    return path


def _read_kept_task(path):
    from mitsim.study.run_folder import read_run

    read_run(path.parent).task()


def _choice(folder):
    from tests.report.choice_run import write_choice

    return write_choice(folder / "choice") / "choice.json"


def _read_choice(path):
    from mitsim.report.choice_page import write_choice_page

    write_choice_page(path.parent)


def _trials(folder):
    from mitsim.study.virtual.trials import Outcome, TrialFolder
    from mitsim.study.virtual.world import Trial

    trials = TrialFolder(folder / "trials", "0123", ["a", "b"], {"a": SimpleNamespace(shape=(2,))})
    for day in range(5):
        trials.add(3, Trial(day), Outcome({"a": 0.1 * day, "b": float("nan")}, {}, {"a": [0.1 * day, float("nan")]}))
    return folder / "trials" / "view_0003.jsonl"


def _read_trials(path):
    from mitsim.study.virtual.trials import TrialFolder

    found = TrialFolder(path.parent, "0123", ["a", "b"], {"a": SimpleNamespace(shape=(2,))})
    trials = list(found.known(3))
    found.errors(3, trials)
    found.deviations(3, trials, "a")


def _plan_of_many(folder):
    path = folder / "many.toml"
    path.write_text(_MANY, encoding="utf-8")
    return path


_MANY = """captures = 3
[views]
subdivisions = 0
standoff_mm = 500
[[finishes]]
name = "ground"
parameters = { plane_Ra = 0.4 }
deviation = "alpha=1"
"""


def _read_many(path):
    from mitsim.sensor.noise_sources import Noise
    from mitsim.sensor.preset import load_sensor
    from mitsim.study.many_captures import CaptureSettings, read_jobs

    common = CaptureSettings({}, "", 1, 1, 1, Noise(), False)
    read_jobs(path, SCENES / "two_pillars" / "two_pillars.xml", load_sensor("ensenso-n10"), common)


#: a drawing's text as OpenCASCADE writes it, without its shapes
_DRAWING = """ISO-10303-21;
HEADER;
FILE_DESCRIPTION(('drawing'),'2;1');
FILE_NAME('a.step','2026-01-01',('a'),('b'),'c','d','e');
FILE_SCHEMA(('AP242_MANAGED_MODEL_BASED_3D_ENGINEERING_MIM_LF'));
ENDSEC;
DATA;
#1=PRODUCT_DEFINITION_SHAPE('','',#2);
#2=PRODUCT_DEFINITION('design','',$,$);
#3=( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) );
#4=SHAPE_ASPECT('face \\X2\\00E9\\X0\\','',#1,.T.);
#5=SHAPE_ASPECT('other','',#1,.F.);
#6=GEOMETRIC_ITEM_SPECIFIC_USAGE('','',#4,#7,#8);
#7=ADVANCED_BREP_SHAPE_REPRESENTATION('',(#8),#9);
#8=ADVANCED_FACE('top',(),#10,.T.);
#10=PLANE('',#11);
#12=DIMENSIONAL_SIZE(#4,'diameter');
#13=DIMENSIONAL_LOCATION('linear distance',$,#4,#5);
#14=DIMENSIONAL_CHARACTERISTIC_REPRESENTATION(#12,#15);
#15=SHAPE_DIMENSION_REPRESENTATION('',(#16),#9);
#16=( LENGTH_MEASURE_WITH_UNIT() MEASURE_REPRESENTATION_ITEM() MEASURE_WITH_UNIT(LENGTH_MEASURE(12.5),#3)
 REPRESENTATION_ITEM('nominal value') );
#17=PLUS_MINUS_TOLERANCE(#18,#12);
#18=TOLERANCE_VALUE(#19,#20);
#19=MEASURE_WITH_UNIT(LENGTH_MEASURE(-0.1),#3);
#20=MEASURE_WITH_UNIT(LENGTH_MEASURE(0.1),#3);
#21=FLATNESS_TOLERANCE('','',#20,#4);
ENDSEC;
END-ISO-10303-21;
"""


def _step(folder):
    path = folder / "drawing.step"
    path.write_text(_DRAWING, encoding="utf-8")
    return path


def _read_step(path):
    from mitsim.scene.authoring.part21 import read_step_text
    from mitsim.scene.authoring.product_information import read_product_information

    read_product_information(read_step_text(path))


def _recording(name):
    def make(folder):
        from tests.capture.recordings.cloud_files_of_others import pcd, pinhole_cloud

        if name == "recording.zip":
            from tests.capture.recordings.test_ensenso_files import files, node, pack

            return pack(folder / name, files(node()))
        if name == "calib.json":
            from tests.capture.recordings.test_ensenso_files import files, node, unpack

            return next(unpack(folder / "recording", files(node())).rglob("*.json"))
        (folder / name).write_bytes(pcd(pinhole_cloud(), "ascii" if "ascii" in name else "binary_compressed"))
        return folder / name

    return make


def _bag(form, compression=None):
    def make(folder):
        from tests.capture.recordings.ros_bags import ROS1, ROS2, cloud, depth_messages, points_m, write_bag

        store = ROS1 if form == "bag" else ROS2
        messages = [*depth_messages(store), ("/points", cloud(store, points_m()))]
        path = write_bag(folder / ("b.bag" if form == "bag" else "b"), messages, form, compression)
        return path.rename(folder / f"recording.{form}")

    return make


def _zdf(folder):
    from tests.capture.recordings.test_grids_and_lenses import CAMERA, LENS, bent_cloud, zdf

    return zdf(folder / "a.zdf", bent_cloud(), camera_matrix=CAMERA.matrix, distortion=LENS)


def _gridless(folder):
    from tests.capture.recordings.cloud_files_of_others import ply
    from tests.capture.recordings.test_grids_and_lenses import bent_cloud

    path = folder / "gridless.ply"
    path.write_bytes(ply(bent_cloud(), grid="none"))
    return path


def _array(channels):
    def make(folder):
        from tests.capture.recordings.cloud_files_of_others import pinhole_cloud

        cloud = pinhole_cloud()
        np.save(folder / "array.npy", cloud if channels else cloud[..., 2])
        return folder / "array.npy"

    return make


def _archive(folder):
    from tests.capture.recordings.cloud_files_of_others import pinhole_cloud

    np.savez_compressed(folder / "array.npz", points=pinhole_cloud(), image=np.zeros((48, 64, 3), np.uint8))
    return folder / "array.npz"


def _points(name):
    """A cloud in a text, of names, decimal commas and empty fields; or in a structure of MATLAB."""

    def make(folder):
        from tests.capture.recordings.cloud_files_of_others import pinhole_cloud

        rows = pinhole_cloud().reshape(-1, 3)[::9].astype(float)
        if name.endswith(".mat"):
            from scipy.io import savemat

            savemat(folder / name, {"cloud": {"Location": rows.T, "Count": len(rows)}})
        else:
            text = "".join(";".join(f"{value:.3f}" for value in row) + "\n" for row in rows)
            (folder / name).write_text("x [mm];y [mm];z [mm]\n" + text.replace("nan", "").replace(".", ","))
        return folder / name

    return make


def _read_points(path):
    from mitsim.decoding.input_clouds import read_cloud

    read_cloud(path)


def _read_any(path):
    from mitsim.capture.recordings.any_recording import read_recording
    from mitsim.capture.recordings.read_options import ReadOptions

    read_recording(path, ReadOptions())


def _read_depths(path):
    from mitsim.capture.recordings.any_recording import read_recording
    from mitsim.capture.recordings.read_options import ReadOptions

    read_recording(path, ReadOptions(sensor="realsense-d435"))


def _read_bag(path):
    """Both topics, of which one may be damaged alone."""
    from mitsim.capture.recordings.any_recording import read_recording
    from mitsim.capture.recordings.read_options import ReadOptions

    read_recording(path, ReadOptions(topic=("/points",), frame="0"))
    read_recording(path, ReadOptions(topic=("/camera/depth/image_rect_raw",), frame="0"))


def _read_recording(path):
    from mitsim.capture.recordings.any_recording import read_recording
    from mitsim.capture.recordings.read_options import ReadOptions

    read_recording(path.parent if path.suffix == ".json" else path, ReadOptions())


READERS: dict[str, Reader] = {
    "sensor.toml": Reader(copied(PRESETS / "ensenso-n10.toml"), _sensor),
    "rig.toml": Reader(copied(PRESETS / "kinect-v2.toml"), _rig),
    "task.toml": Reader(copied(SCENES / "two_pillars" / "task.toml"), _task),
    "study.toml": Reader(_study, _read_study),
    "campaign.toml": Reader(copied(SCENES / "coupon" / "campaign.toml"), _read_campaign),
    "scene.xml": Reader(copied(SCENES / "two_pillars" / "two_pillars.xml"), _scene),
    "coupon.xml": Reader(copied(SCENES / "coupon" / "coupon.xml"), _scene),
    "map.nc": Reader(_run_folder("map.nc"), _map),
    "map.nc, bent": Reader(_run_folder("map.nc"), _map, True),
    "scores.nc": Reader(_run_folder("scores.nc"), _read_run),
    "scores.nc, bent": Reader(_run_folder("scores.nc"), _read_run, True),
    "checks.nc, bent": Reader(_run_folder("checks.nc"), _read_run, True),
    "samples.nc, bent": Reader(_run_folder("samples.nc"), _read_run, True),
    "run.json": Reader(_run_folder("run.json"), _read_run),
    "statement.json": Reader(_run_folder("statement.json"), _read_run),
    "capture.json": Reader(_run_folder("captures/view_0004/capture.json"), _capture),
    "calibration.json of a capture": Reader(_run_folder("captures/view_0004/calibration.json"), _capture),
    "pose.json": Reader(_pose, _read_pose),
    "patches.npy": Reader(_patches, _read_patches),
    "stand.npz": Reader(_run_folder("stand.npz"), _read_scene_geometry),
    "task.json": Reader(_kept_task, _read_kept_task),
    "choice.json": Reader(_choice, _read_choice),
    "trials": Reader(_trials, _read_trials),
    "plan of many": Reader(_plan_of_many, _read_many),
    "drawing.step": Reader(_step, _read_step),
    **{
        name: Reader(_recording(name), _read_recording)
        for name in ("ascii.pcd", "compressed.pcd", "recording.zip", "calib.json")
    },
    "recording.bag": Reader(_bag("bag"), _read_bag),
    "packed.bag": Reader(_bag("bag", "LZ4"), _read_bag),
    "recording.db3": Reader(_bag("db3"), _read_bag),
    "recording.mcap": Reader(_bag("mcap"), _read_bag),
    "cloud.zdf": Reader(_zdf, _read_any),
    "gridless.ply": Reader(_gridless, _read_any),
    "points.npy": Reader(_array(3), _read_any),
    "depths.npy": Reader(_array(0), _read_depths),
    "points.npz": Reader(_archive, _read_any),
    "points.csv": Reader(_points("points.csv"), _read_points),
    "points.mat": Reader(_points("points.mat"), _read_points),
    "cloud.ply": Reader(_cloud, _read_cloud),
    "foreign.ply": Reader(_foreign, _decode_foreign),
    "image.png": Reader(_image, _read_image),
    "image.png of a projector": Reader(_image, _read_projector_image),
    "calibration.yml": Reader(_opencv(".yml"), _read_calibration),
    "calibration.xml": Reader(_opencv(".xml"), _read_calibration),
    "calibration.json": Reader(_opencv(".json"), _read_calibration),
    "calibration.mat": Reader(_matlab, _read_calibration),
    "calibration.npz": Reader(_npz, _read_calibration),
    "calibration.yaml of ROS": Reader(_ros, _read_cameras),
    "camchain.yaml": Reader(_kalibr, _read_cameras),
    "settings of ORB-SLAM3": Reader(_orb_slam, _read_cameras),
    "cameras of MC-Calib": Reader(_mc_calib, _read_cameras),
    "quaternion.json": Reader(_quaternion, _read_cameras),
    "pose of ROS": Reader(_pose_of_ros, _read_pose_option),
    "stack.tif": Reader(_stack_of_pages, _read_stack),
    "stereo.mat": Reader(_toolbox, _read_cameras),
    "maps.json": Reader(_maps_of_cameras("maps.json"), _read_cameras),
    "maps.yaml": Reader(_maps_of_cameras("maps.yaml"), _read_cameras),
    **{name: Reader(_form(name), _read_form) for name in _FORMS},
    "heights.npy": Reader(_heights(".npy"), _read_heights),
    "heights.csv": Reader(_heights(".csv"), _read_heights),
    "profile.csv": Reader(_profile, _read_profile),
    "part.stl": Reader(_mesh(".stl"), _read_mesh),
    "part.ply": Reader(_mesh(".ply"), _read_mesh),
    "part.obj": Reader(_mesh(".obj"), _read_mesh),
    "part.off": Reader(_mesh(".off"), _read_mesh),
    "part.glb": Reader(_mesh(".glb"), _read_mesh),
    "mitsim report of scores.nc": Reader(_run_folder("scores.nc"), _report, True),
    "mitsim report of map.nc": Reader(_run_folder("map.nc"), _report, True),
    "mitsim report of run.json": Reader(_run_folder("run.json"), _report),
    "mitsim check": Reader(copied(SCENES / "two_pillars" / "two_pillars.xml"), lambda path: command("check", path)),
    "mitsim part": Reader(_mesh(".stl"), lambda path: command("part", path, "-o", path.parent / "out")),
    "mitsim map compare": Reader(
        _run_folder("map.nc"), lambda path: command("map", "compare", path, "-o", path.parent / "out"), True
    ),
}
