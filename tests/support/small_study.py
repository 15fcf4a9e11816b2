"""A study of seconds: four short runs, one of which another waits for, and a figure."""

from bench.analysis import plot_errors
from bench.batch import ResultTable, RunSeries, Study, StudyResult
from bench.record import Record

SETTINGS = {"duration": "4", "settling": "2"}


def readings(run):
    with Record(run.folder) as record:
        return record.telemetry()["curvature"]


def carry_out(campaign: RunSeries) -> StudyResult:
    """Hold the temperature in each run, and start one that depends on the results of the others."""
    runs = [campaign.start("creep", {**SETTINGS, "hot": hot}) for hot in ("65", "70", "75")]
    found = [readings(run.result()) for run in runs]
    hot = 70 + sum(values[-1] > 0 for values in found)
    found.append(readings(campaign.run("creep", {**SETTINGS, "hot": str(hot)})))
    figure = campaign.draw("curvature", plot_errors, {"last": found[-1]}, error_label="curvature / (1/m)")
    return StudyResult(
        {"curvatures": [values.tolist() for values in found]},
        (ResultTable("runs", ("run",), [["{curvatures[0]}"]]),),
        (figure,),
    )


def carry_out_wrongly(campaign: RunSeries) -> StudyResult:
    """Start a run that is refused beside one that goes on."""
    campaign.start("damped-oscillation", {})
    campaign.start("creep", {**SETTINGS, "hot": "1000"}).result()
    raise AssertionError("not reached")


STUDY = Study("vo2", "a small study", "For the tests.", carry_out)
WRONG = Study("vo2", "a wrong study", "For the tests.", carry_out_wrongly)
