"""Free parameters of fits: light, lamps, materials, poses, planes, shapes, cameras, exposure.

Each starts where the scene has it. Values are in natural units (radians, half diagonals of bodies, reflectances, the
targets' own radiance), so that one learning rate serves all.
"""
