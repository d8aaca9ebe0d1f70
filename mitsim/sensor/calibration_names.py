"""List the names under which OpenCV and other programs store the values of a calibration."""

from __future__ import annotations

Names = tuple[str, ...]

#: Names searched unless the sensor file gives others: for the first camera, the second, the projector. Names with a
#: plus are composed of other values, see :mod:`mitsim.sensor.calibration_tree`.
_WRITTEN: dict[str, tuple[str, str, str]] = {
    "matrix": (
        """
        camera_matrix camera_K cam_K cam_int Kc K_c K K1 M1 cameraMatrix cameraMatrix1 cameraMatrixL
        camera_matrix_1 camera_matrix_left K_left left_camera_matrix KL mtx mtx1 mtxL intrinsic_matrix +K_left
        +K_cam +K_camera +K1 +K
        """,
        """
        K2 M2 cameraMatrix2 cameraMatrixR camera_matrix_2 camera_matrix_right K_right right_camera_matrix KR
        mtx2 mtxR +K_right +K2
        """,
        """
        projector_matrix projector_K proj_K proj_int pro_K pro_int Kp K_p proj_mtx K2 M2 cameraMatrix2 +K_proj
        +K_projector +K_right +K2
        """,
    ),
    "distortion": (
        """
        distortion_coefficients distortionCoefficients distortion_coeffs distortionCoeffs distortion_coeff
        distortion_params distortion_parameters dist_coeffs dist_coeff dist_coefs distCoeff
        distortion camera_distortion cam_kc cam_dist kc Dc D D1 distCoeffs distCoeffs1 distCoeffsL
        distortion_coefficients_1 distortion_coefficients_left D_left left_distortion
        left_distortion_coefficients kc_left kc_cam DL dist dist1 distL distortion_vector +D1
        """,
        """
        D2 distCoeffs2 distCoeffsR distortion_coefficients_2 distortion_coefficients_right D_right
        right_distortion right_distortion_coefficients kc_right DR dist2 distR +D2
        """,
        """
        projector_distortion proj_kc pro_kc pro_dist proj_dist kp Dp kc_proj kc_projector D2 distCoeffs2
        kc_right +D_proj +D2
        """,
    ),
    "size": (
        """
        image_size imageSize camera_size cam_size camera_resolution cam_resolution img_size frame_size frameSize
        resolution +size
        """,
        """
        image_size_2 image_size imageSize camera_size cam_size camera_resolution img_size frame_size frameSize
        resolution +size2 +size
        """,
        "projector_size projectorSize proj_size pro_size projector_resolution proj_resolution pattern_size +size_proj",
    ),
    "rotation": (
        "",
        "R rotation rotation_matrix quaternion quaternion_xyzw quaternion_wxyz R_stereo om +R",
        """
        R projector_R proj_R pro_R Rp R_p rotation rotation_matrix quaternion quaternion_xyzw quaternion_wxyz om
        +R_proj +R
        """,
    ),
    "translation": (
        "",
        "T t translation translation_vector T_stereo +T",
        "T t projector_T projector_t proj_T proj_t pro_T pro_t Tp tp T_p translation translation_vector +T_proj +T",
    ),
}

USUAL_NAMES: dict[str, tuple[Names, Names, Names]] = {
    quantity: (tuple(first.split()), tuple(second.split()), tuple(projector.split()))
    for quantity, (first, second, projector) in _WRITTEN.items()
}
