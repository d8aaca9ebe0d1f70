"""Compare sensors: screen all of them, and measure the promising ones until every verdict is clear or time is over.

Signal chain: sensors -> scores of all views of each sensor (kept in its folder) -> order by impossible measurements,
then by the worst of the others (:mod:`mitsim.study.choose.ranking`) -> exclusion of sensors that can make fewer
measurements, or whose demand is far too large -> a statement of few trials from the view that screening finds best ->
rounds of those that can still win, with races and more trials (:mod:`mitsim.study.choose.rounds`) -> more trials for
the leader -> its folder, as of a run (:mod:`mitsim.study.run_record`), and ``choice.json``.

Screening takes at most half of the time: within its share, a sensor scores views that lie far apart. The first round
gives every sensor the same share of half of the time that is left, without a race, so that each has a statement. Each
later one keeps the sensors whose demand may still be the least, and gives each a share of half of the time that is left
(successive halving: Karnin et al., ICML 2013).

Screening includes noise and calibration, but not finish, interreflections at edges and false points. It is therefore
more often too small than too large, and a sensor is excluded if even the screened demand of its best view exceeds
:data:`mitsim.study.choose.ranking.LARGEST_DEMAND`. A measurement that screening excludes for every sensor excludes none
of them, nor does a tolerance that no sensor comes near.

Finished work is on the disk, so an interrupted command continues. In a round the sensors are measured one after the
other, and the memory of each is released before the next.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from characterisation.words.numbers import two_digits
from characterisation.words.progress import say
from mitsim.running.executor import Executor, giving_up
from mitsim.running.time_limit import TimeLimit
from mitsim.study.choose.candidates import CandidateSensor
from mitsim.study.choose.ranking import rank_keys, unpromising
from mitsim.study.choose.rounds import able_to_win, race_and_state, race_as_stated, refine_leader, state_by_screening
from mitsim.study.choose.screened_sensor import screen_sensor
from mitsim.study.choose.sensor_result import SensorResult, ordered
from mitsim.study.run_record import complete_winner
from mitsim.study.session import Session
from mitsim.study.statement_file import FEW_TRIALS
from mitsim.study.virtual.race import ALL

#: factor of the trials from round to round; chosen
GROWTH = 2

#: largest share of the time for screening
_SCREENING_SHARE = 0.5

#: share of the time that is left for a round of several sensors; chosen
_ROUND_SHARE = 0.5

#: largest number of rounds; chosen
_ROUNDS = 7


def choose_sensor(
    candidates: list[CandidateSensor],
    folder: Path,
    limit: TimeLimit,
    report_results: Callable[[list[SensorResult], bool], None],
    workers: Executor | None = None,
) -> list[SensorResult]:
    """Screen, race and state sensors; return them, best first.

    Parameters
    ----------
    candidates, folder
        Sensors, each with the study for it; finished work is kept in a folder of ``folder`` for each.
    limit, workers
        Time of the whole, shared among the sensors; processes or cluster that make the trials, by default this process.
    report_results
        Receives the results so far after each sensor, and whether they are final: not where time ended the work.
    """
    results = list[SensorResult]()
    screening = limit.part(_SCREENING_SHARE)
    equal = screening.left / len(candidates)
    for number, candidate in enumerate(candidates, 1):
        share = screening.part(1 / (len(candidates) - number + 1))
        results.append(
            screen_sensor(candidate, Session(candidate.study, folder / candidate.name, workers), share, equal)
        )
        _say(results, f"{number} of {len(candidates)} screened", limit)
    report_results(ordered(results), False)
    with giving_up(workers, lambda: limit.left <= _reserve(limit)):
        _measure_in_rounds(results, limit, report_results)
        leader, rest = ordered(results)[0], limit.part(1.0, _reserve(limit))
        if leader.stated and not limit.over():
            refine_leader(leader, rest)
        in_time = not rest.over()
    _complete(ordered(results)[0])
    report_results(ordered(results), in_time)
    return ordered(results)


def _measure_in_rounds(
    results: list[SensorResult], limit: TimeLimit, report_results: Callable[[list[SensorResult], bool], None]
) -> None:
    """Measure the promising sensors in rounds, until one is left or time is over."""
    rivals, count = _promising(results), FEW_TRIALS
    raced = len(rivals) == 1
    for turn in range(_ROUNDS):
        work = limit.part(_ROUND_SHARE if len(rivals) > 1 else 1.0, _reserve(limit))
        for index, rival in enumerate(rivals):
            if limit.over() and (index or turn):
                unmeasured = sum(not result.stated for result in rivals)
                if unmeasured:
                    say(f"choose: time is over; {unmeasured} sensors are judged by screening alone")
                break
            share = work.part(1 / (len(rivals) - index))
            if raced:
                race_and_state(rival, count, share)
            else:
                state_by_screening(rival, count, share, limit)
            _say(results, f"round {turn + 1}: {index + 1} of {len(rivals)} sensors measured", limit)
            report_results(ordered(results), False)
        if any(result.stated for result in results):
            rivals, count, raced = able_to_win(results, rivals), GROWTH * count, True
        else:  # every share was too short for a statement: the first rival, best by screening, gets what is left
            rivals = rivals[:1]
        if limit.over() or not rivals or (len(rivals) == 1 and rivals[0].raced is not None):
            break


def _reserve(limit: TimeLimit) -> float:
    """Return the time [s] that the pages and the winner's folder need; nothing without a limit."""
    return 0.0 if limit.end is None else min(10.0, 0.1 * (limit.end - limit.began))


def _complete(winner: SensorResult) -> None:
    """Complete the folder of the best sensor, if it was measured."""
    if not winner.stated:
        return
    session = winner.session
    best_rows = zip(session.study.task.measurements, winner.best(), strict=True)
    leaders = {ALL: next(iter(winner.stated))} | {name: row[0] for name, row in best_rows if row is not None}
    complete_winner(session, winner.scores, race_as_stated(winner), leaders)
    session.release()


def _promising(results: list[SensorResult]) -> list[SensorResult]:
    """Return the sensors worth a virtual measurement, best first: at least one if any sensor can measure at all."""
    keys = rank_keys([result.screened for result in results], results[0].has_tolerance)
    for result, reason in zip(results, unpromising(keys, any(results[0].has_tolerance)), strict=True):
        result.unpromising = reason
    order = sorted(range(len(results)), key=keys.__getitem__)
    return [results[i] for i in order if not results[i].unpromising]


def _say(results: list[SensorResult], done: str, limit: TimeLimit) -> None:
    """Print the progress and the leading sensor."""
    first = ordered(results)[0]
    names = list(first.candidate.study.task.measurements)
    rows = first.demands()
    by = "measured" if first.stated else "by the screening"
    left = limit.left
    possible = [m for m, value in enumerate(rows) if math.isfinite(value)]
    if not possible:
        say(f"choose: {done}; no sensor can make a measurement {by}; {left:.0f} s left")
        return
    limited = [m for m in possible if first.has_tolerance[m]]
    worst = max(limited or possible, key=rows.__getitem__)
    measurement = first.candidate.study.task.measurements[names[worst]]
    unit = "times the limit" if first.has_tolerance[worst] else measurement.unit
    demand_in_words = f"{two_digits(rows[worst])} {unit} ({names[worst]})"
    if len(possible) < len(rows):
        demand_in_words += f", {len(possible)} of {len(rows)} measurements possible"
    say(f"choose: {done}; {first.candidate.name} leads {by}, at worst {demand_in_words}; {left:.0f} s left")
