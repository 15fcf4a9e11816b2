from .device import (
    DONE as DONE,
    END as END,
    GLANCE as GLANCE,
    IDENTITY as IDENTITY,
    MEASURE as MEASURE,
    OFF as OFF,
    OUTPUT as OUTPUT,
    REFUSED as REFUSED,
    SET as SET,
    TwinSettings as TwinSettings,
    number_text as number_text,
)
from .specimen import (
    Specimen as Specimen,
)
from .tables import (
    BoardTable as BoardTable,
    NoiseTable as NoiseTable,
    SetUpTable as SetUpTable,
    TwinTable as TwinTable,
    rounded as rounded,
)
from .write import (
    write_twin as write_twin,
)
