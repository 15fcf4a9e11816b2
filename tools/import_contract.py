"""A contract of import-linter: other packages use a package through its public interface only."""

from __future__ import annotations

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, fields, output


class PublicInterfaces(Contract):
    """Packages of a container are imported as `container.package`, never one of their modules.

    Fields
    ------
    container : module
        Package whose children have public interfaces.
    public_modules : list of str
        Modules within them that others may import.
    """

    container = fields.ModuleField()
    public_modules = fields.ListField(subfield=fields.StringField(), required=False)

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:  # noqa: ARG002 - of the interface
        """Find the imports that reach past an interface."""
        depth = str(self.container).count(".") + 2
        allowed = set(self.public_modules or ())
        past = []
        for imported in sorted(graph.find_descendants(str(self.container))):
            package = ".".join(imported.split(".")[:depth])
            if imported == package or imported in allowed:
                continue
            for importer in sorted(graph.find_modules_that_directly_import(imported)):
                if importer != package and not importer.startswith(f"{package}."):
                    past.append((importer, imported))
        return ContractCheck(kept=not past, metadata={"past": past})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Print them."""
        past: list[tuple[str, str]] = check.metadata["past"]
        for importer, imported in past:
            output.print_error(f"{importer} imports {imported}, which is no public interface")
