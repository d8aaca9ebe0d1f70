"""Make the report of a run, one page with pictures, from the run's folder alone.

Signal chain:

- :mod:`~mitsim.study.run_folder` reads and checks the folder.
- :mod:`~mitsim.report.findings` derives results; :mod:`~mitsim.report.agreement` compares predictions with errors.
- :mod:`~mitsim.report.figures` draws the map, :mod:`~mitsim.report.view_figures` the views and
  :mod:`~mitsim.report.cloud_figures` images and clouds. :mod:`~mitsim.report.page_pictures` writes their captions.
- :mod:`~mitsim.report.view_sphere` makes the interactive sphere of views from :mod:`~mitsim.report.view_data`.
- :mod:`~mitsim.report.page` writes ``report.html``.

This package does not simulate, decode or score. A report can therefore be made again later, on another machine, from
the files.
"""
