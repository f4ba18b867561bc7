from systems import configured, problem

from cconv.training.geometry_cache import GeometryCache


def test_keeps_geometries_until_the_memory_is_used_up(generator):
    given = problem(generator)
    model = given.build_model(configured(layers=1, kernel_size=3), 0)
    sizes = [model.geometry(sample.inputs).nbytes for sample in given.train_samples]
    cache = GeometryCache(model.geometry, max_bytes=sizes[0] + sizes[1])
    first = [cache(sample) for sample in given.train_samples]
    again = [cache(sample) for sample in given.train_samples]
    assert [a is b for a, b in zip(first, again, strict=True)] == [True, True, False, False]


def test_samples_of_other_splits_are_not_confused(generator):
    given = problem(generator)
    model = given.build_model(configured(layers=1, kernel_size=3), 0)
    cache = GeometryCache(model.geometry, max_bytes=2**30)
    assert cache(given.train_samples[0]) is not cache(given.valid_samples[0])
