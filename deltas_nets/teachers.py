"""Detectors to distil from, by the name under which they were first found."""

from deltas_nets.distill.teachers import LICENCES, TEACHERS, Teacher, load_teacher

__all__ = ["LICENCES", "TEACHERS", "Teacher", "load_teacher"]
