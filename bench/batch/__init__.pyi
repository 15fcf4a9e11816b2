from .campaign.cluster import (
    ClusterExecutor as ClusterExecutor,
    check_address as check_address,
)
from .campaign.execution import (
    Executor as Executor,
    WorkersExecutor as WorkersExecutor,
    all_carried_out as all_carried_out,
    carry_out_tasks as carry_out_tasks,
    done_before as done_before,
    holder as holder,
    opened_folder as opened_folder,
)
from .campaign.expansion import (
    Expansion as Expansion,
    expand as expand,
)
from .campaign.file import (
    read_campaign as read_campaign,
)
from .campaign.results import (
    ResultsTable as ResultsTable,
    comparisons_table as comparisons_table,
    in_one_cell as in_one_cell,
    over_runs as over_runs,
    over_seeds as over_seeds,
    runs_table as runs_table,
    shown_columns as shown_columns,
    studies_of as studies_of,
    studies_table as studies_table,
    study_values as study_values,
    together as together,
    write_tables as write_tables,
)
from .campaign.study_tables import (
    MARKDOWN_NAME as MARKDOWN_NAME,
    print_over_seeds as print_over_seeds,
)
from .campaign.tasks import (
    UNFINISHED as UNFINISHED,
    CampaignTask as CampaignTask,
    Done as Done,
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
