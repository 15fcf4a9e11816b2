"""Where the sparse columns of a regressor lie in the Preisach plane: neighbours, coarser planes, roughness."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bench.base import Floats

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class CellLayout:
    """The cell of each sparse column of a regressor."""

    order: int  # number of intervals M of the plane, 0 if the columns have no place
    # Shape (columns,); cell of each sparse column. A cell may have a second column, that of its relays which were on
    # before the first sample; its density then is the sum of the two coefficients.
    cells: Indices
    layers: Indices  # shape (columns,); 0 for the first column of a cell, 1 for the second

    @classmethod
    @lru_cache(maxsize=8)
    def of(cls, columns: int) -> CellLayout:
        """Return the layout of one column a cell, if their number is that of a plane."""
        order = (round((8 * columns + 1) ** 0.5) - 1) // 2
        if order * (order + 1) // 2 != columns:
            order = 0
        return cls(order, np.arange(columns), np.zeros(columns, dtype=np.int64))

    def _places(self) -> tuple[Indices, Indices, Indices]:
        rows, columns = np.tril_indices(self.order)
        return self.layers, rows[self.cells] + 1, columns[self.cells] + 1

    def crests(self, g: Floats, threshold: float) -> Indices:
        """Return the columns of at least a threshold, of neighbouring cells only the best.

        Neighbours are nearly collinear: entering together they would only push each other out again.
        """
        if not self.order:
            return np.flatnonzero(g >= threshold)
        from bench.identification.kernels import constrained_fit_kernels as _kernels

        return np.flatnonzero(_kernels.crests(g, threshold, self.neighbours))

    @cached_property
    def neighbours(self) -> Indices:
        """The columns of the four neighbouring cells of each column, of its layer, shape (columns, 4); -1: none."""
        index = np.full((2, self.order + 2, self.order + 2), -1, dtype=np.int64)
        layer, row, column = self._places()
        index[layer, row, column] = np.arange(self.cells.size)
        beside = ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1))
        return np.stack([index[layer, i, j] for i, j in beside], axis=1)

    def coarser(self) -> tuple[CellLayout, Indices]:
        """Return the layout of the plane with cells merged two by two, and the column of each column there."""
        rows, columns = np.tril_indices(self.order)
        i, j = rows[self.cells] // 2, columns[self.cells] // 2
        # One number is sorted faster than a pair.
        merged, parents = np.unique(self.layers * rows.size + i * (i + 1) // 2 + j, return_inverse=True)
        return CellLayout((self.order + 1) // 2, merged % rows.size, merged // rows.size), parents

    @cached_property
    def roughness(self) -> csr_array:
        """LᵀL of the discrete Laplacian L of the density on the plane, one row and column a column."""
        from scipy.sparse import csr_array, diags_array

        rows, columns = np.tril_indices(self.order)
        # Numbers of 32 bits halve what the products below take.
        index = np.full((self.order + 1, self.order + 1), -1, dtype=np.int32)
        index[rows, columns] = np.arange(rows.size)
        here: list[NDArray[np.int32]] = []
        there: list[NDArray[np.int32]] = []
        for i, j in ((rows + 1, columns), (rows - 1, columns), (rows, columns + 1), (rows, columns - 1)):
            inside = (i >= 0) & (j >= 0) & (index[i, j] >= 0)
            here.append(index[rows, columns][inside])
            there.append(index[i, j][inside])
        places = np.concatenate(here), np.concatenate(there)
        beside = csr_array((np.ones(places[0].size), places), shape=(rows.size, rows.size))
        laplacian = csr_array(diags_array(beside.sum(axis=0)) - beside)
        # It is symmetric.
        return csr_array(laplacian[self.cells] @ laplacian[:, self.cells])


@dataclass(frozen=True, eq=False)
class PlanesBeside(CellLayout):
    """The cells of several planes, whose columns stand one plane after the other."""

    # Layout of each plane. The order of the whole is the least, and 0 if the columns of one have no place.
    planes: tuple[CellLayout, ...]

    @classmethod
    def of_planes(cls, *planes: CellLayout) -> PlanesBeside:
        """Return the layout of planes beside each other."""
        return cls(
            min(plane.order for plane in planes),
            np.concatenate([plane.cells for plane in planes]),
            np.concatenate([plane.layers for plane in planes]),
            planes,
        )

    @cached_property
    def neighbours(self) -> Indices:
        """The neighbours of each column, of its own plane, as those of a `CellLayout`."""
        found, before = [], 0
        for plane in self.planes:
            found.append(np.where(plane.neighbours < 0, -1, plane.neighbours + before))
            before += plane.cells.size
        return np.concatenate(found)

    def coarser(self) -> tuple[CellLayout, Indices]:
        """Return the layout with the cells of each plane merged two by two, and the column of each column there."""
        merged, parents = zip(*(plane.coarser() for plane in self.planes), strict=True)
        before = np.cumsum([0, *(plane.cells.size for plane in merged)])
        return self.of_planes(*merged), np.concatenate([each + n for each, n in zip(parents, before, strict=False)])

    @cached_property
    def roughness(self) -> csr_array:
        """LᵀL of the discrete Laplacians of the densities, each on its plane."""
        from scipy.sparse import block_diag, csr_array

        return csr_array(block_diag([plane.roughness for plane in self.planes]))
