from .campaign.cluster import (
    ClusterExecutor as ClusterExecutor,
    check_address as check_address,
)
from .campaign.execution import (
    Executor as Executor,
    WorkersExecutor as WorkersExecutor,
    carry_out_tasks as carry_out_tasks,
    done_before as done_before,
    opened_folder as opened_folder,
)
from .campaign.expansion import (
    expand as expand,
)
from .campaign.file import (
    read_campaign as read_campaign,
)
from .campaign.results import (
    show_results as show_results,
)
from .study import (
    ResultTable as ResultTable,
    RunSeries as RunSeries,
    Study as Study,
    StudyResult as StudyResult,
    prepare as prepare,
    published_of as published_of,
    reached_targets as reached_targets,
    reproduce as reproduce,
    true_errors as true_errors,
)
from .tuning.tune import (
    tune as tune,
)
