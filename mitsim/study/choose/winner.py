"""Complete the folder of the sensor that measures best, so that reports and exports read it as that of a run."""

from __future__ import annotations

import xarray as xr

from characterisation.files.atomic_io import write_json
from mitsim.study.run_files import digests_of
from mitsim.study.run_record import draw_clouds, own_files, run_record, runners_up
from mitsim.study.scoring import write_inputs, write_raced
from mitsim.study.session import Session
from mitsim.study.virtual.race import Raced
from mitsim.views.view_scores import not_scored_in_words


def complete_winner(session: Session, scores: xr.Dataset, raced: Raced, leaders: dict[str, int]) -> None:
    """Write everything of a run into the folder of a sensor that has its statement; ``run.json`` last.

    Parameters
    ----------
    session
        The sensor's, with the folder.
    scores
        Scores of all views by screening.
    raced
        Race of the promising views.
    leaders
        Best view of every measurement, and of all measurements.
    """
    study, folder = session.study, session.folder
    performance_map = study.performance_map
    assert performance_map is not None  # sensors are screened with a map
    (folder / "run.json").unlink(missing_ok=True)
    (folder / "clouds").mkdir(exist_ok=True)
    performance_map.save(folder / "map.nc")
    write_inputs(session)
    write_raced(session, scores, raced)
    drawn = sorted(set(leaders.values()))
    draw_clouds(session, performance_map, drawn)
    about = run_record(study, performance_map, raced, [], None) | {"leaders": leaders}
    about["runners_up"] = runners_up(session, raced)
    about["lacks"] = list(filter(None, [not_scored_in_words(scores)]))
    about["files"] = digests_of(folder, own_files(study, drawn, [], stated=True))
    write_json(folder / "run.json", about)
