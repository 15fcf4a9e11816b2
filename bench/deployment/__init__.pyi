from .c_source import (
    Real as Real,
    compile_library as compile_library,
)
from .controller import (
    CONTROLLERS as CONTROLLERS,
    Controller as Controller,
    controller_of_rig as controller_of_rig,
)
from .export import (
    Deployment as Deployment,
    deploy as deploy,
)
from .fmu import (
    Version as Version,
    What as What,
    write_fmu as write_fmu,
)
