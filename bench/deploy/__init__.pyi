from .c_source import (
    Real as Real,
)
from .export import (
    Deployment as Deployment,
    deploy as deploy,
)
