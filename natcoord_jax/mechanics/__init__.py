"""Equations of a model: kinematics, residuals, blocks, tangent spaces; functions of arrays, no iteration."""
