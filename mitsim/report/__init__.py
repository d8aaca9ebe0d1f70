"""The report of a run: one page with pictures, made from the run's folder alone.

Signal chain: run folder -> :mod:`~mitsim.report.run_folder` (read and checked) -> :mod:`~mitsim.report.findings` (what
the numbers say) and :mod:`~mitsim.report.agreement` (whether the prediction held) -> pictures
(:mod:`~mitsim.report.figures` of the map, :mod:`~mitsim.report.view_figures` of the views,
:mod:`~mitsim.report.cloud_figures` of images and clouds) with their captions (:mod:`~mitsim.report.page_pictures`), and
the sphere of views that a browser turns (:mod:`~mitsim.report.view_sphere`, its numbers
:mod:`~mitsim.report.view_data`) -> :mod:`~mitsim.report.page`, ``report.html``.

Nothing here simulates, decodes or scores: a report can be made again, elsewhere and later, from the files.
"""
