"""The papers' results, reproduced on the emulated rigs at the wire level: one module a paper."""
