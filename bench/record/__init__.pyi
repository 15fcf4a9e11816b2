from . import (
    rows as rows,
)
from .card import (
    card_rows as card_rows,
    expected_steps as expected_steps,
    interlocks_of as interlocks_of,
    run_card as run_card,
    steps_of as steps_of,
)
from .ending import (
    BEGIN as BEGIN,
    BLACK_BOX_NAME as BLACK_BOX_NAME,
    END as END,
    FAILED as FAILED,
    Ending as Ending,
    ending_of as ending_of,
)
from .finding import (
    files_of as files_of,
    find_journals as find_journals,
)
from .kept_files import (
    PROTOCOL_NAME as PROTOCOL_NAME,
    RIG_FILE_NAME as RIG_FILE_NAME,
    Original as Original,
    file_name as file_name,
    given_files as given_files,
    unpack as unpack,
)
from .lateness import (
    Lateness as Lateness,
    bins_of as bins_of,
    headline_of as headline_of,
    lateness_lines as lateness_lines,
)
from .model_files import (
    add_model as add_model,
)
from .reading import (
    Record as Record,
)
from .recovery import (
    recover as recover,
)
from .rows import (
    FILE_NAME as FILE_NAME,
    RECOVERED_NAME as RECOVERED_NAME,
    SCHEMA as SCHEMA,
    Event as Event,
    StepRecord as StepRecord,
)
from .run_metadata import (
    Difference as Difference,
    NewFolder as NewFolder,
    current_user as current_user,
    differences as differences,
    metadata as metadata,
    run_name as run_name,
    version_of as version_of,
)
from .second_file import (
    NAME as NAME,
)
from .table import (
    Table as Table,
)
from .writing import (
    Journal as Journal,
    abandon as abandon,
    take_in as take_in,
)
