"""Data sets: images of random scenes, with labels, in shards for WebDataset and torch's loaders.

A :class:`Recipe` describes the data set, :func:`load_recipe` reads one; a :class:`DataSet` draws its scenes, by their
numbers, and :func:`write_shards` renders them; :func:`read_shard` reads a shard back.
"""

from warpshadow.dataset.data_set import DataSet
from warpshadow.dataset.recipe import Recipe, RecipeError, load_recipe
from warpshadow.dataset.samples import Sample, read_shard
from warpshadow.dataset.shards import Shard, write_shards

__all__ = ["DataSet", "Recipe", "RecipeError", "Sample", "Shard", "load_recipe", "read_shard", "write_shards"]
