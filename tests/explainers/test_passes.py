"""Engines answer as the network does, or are not used."""

import pytest
import torch
from torch import nn

from sliplens.errors import InputError, ModelError
from sliplens.explainers.poly_cam import PolyCam
from sliplens.models.engines import ENGINES, counting_passes, prepare


class Branches(nn.Module):
    """A network whose graph depends on its input: a trace keeps the branch of the example, all zeros."""

    def __init__(self) -> None:
        super().__init__()
        self.maps = nn.Conv2d(3, 4, 3, stride=2)

    def forward(self, images):
        features = self.maps(images).mean(dim=(1, 2, 3))
        return 2 * features if float(images.sum()) > 0 else features


def ready(model, images, *, engine="auto", batch_size=None, count=10_000):
    with torch.no_grad():
        predictions = model(images).flatten()
        return prepare(model, images, predictions, passes=count, engine=engine, batch_size=batch_size), predictions


@pytest.fixture
def float_network(network):
    return network("small shufflenet").float().requires_grad_(requires_grad=False)


@pytest.mark.parametrize("engine", ["eager", "folded", "onnxruntime", "openvino"])
def test_answers_in_order_and_as_the_network_does(engine, float_network, images):
    one = images.float()
    found, _ = ready(float_network, one[:2], engine=engine, batch_size=2)
    batches = [one[:2], one[1:], one[:1], one[:2], one[2:]]  # short ones among them
    with torch.no_grad():
        expected = [float_network(batch).flatten() for batch in batches]
    answers = list(found.run(iter(batches)))
    assert [len(answer) for answer in answers] == [2, 2, 1, 2, 1]
    torch.testing.assert_close(torch.cat(answers), torch.cat(expected), atol=1e-5, rtol=1e-5)


def test_the_exact_map_is_that_of_the_plain_loop(float_network, images):
    image = images[:1].float()
    plain = PolyCam(engine="eager", batch_size=1)(float_network, image)
    quick = PolyCam(engine="openvino")(float_network, image)
    assert (plain.engine, quick.engine) == ("eager", "openvino")
    torch.testing.assert_close(quick.saliency, plain.saliency, atol=1e-4, rtol=0)


def test_the_best_engine_that_pays_is_taken(float_network, images):
    assert ready(float_network, images[:1].float(), count=1)[0].name == "eager"
    # earlier calls count: frames are explained one by one
    for name in ("folded", "openvino"):
        assert ready(float_network, images[:1].float(), count=ENGINES[name].pays_after or 0)[0].name == name


def test_an_engine_is_chosen_alike_whether_or_not_something_ran_before(float_network, images):
    def name(count: int) -> str:
        return ready(float_network, images[:1].float(), count=count)[0].name

    fresh = name(1)
    name(10_000)
    with counting_passes():
        assert [fresh, name(1)] == ["eager", "eager"]
    assert name(1) == "openvino"


def test_new_weights_are_converted_anew(float_network, images):
    ready(float_network, images[:1].float(), engine="openvino")
    float_network.fc.weight.mul_(-1)
    found, predictions = ready(float_network, images[:1].float(), engine="openvino")
    torch.testing.assert_close(next(found.run([images[:1].float()])), predictions, atol=1e-5, rtol=1e-5)


def test_an_engine_that_answers_otherwise_is_not_used(images):
    model, one = Branches(), images[:1].float()
    assert ready(model, one)[0].name != "openvino"
    with pytest.raises(ModelError, match=r"the engine openvino cannot run Branches \(its answers differ by .*; choose"):
        ready(model, one, engine="openvino")


def test_a_network_that_cannot_be_copied_runs_as_it_is(images):
    class Uncopied(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.maps = nn.Conv2d(3, 4, 3)

        def __deepcopy__(self, memo):
            raise RuntimeError("holds a file")

        def forward(self, images):
            return self.maps(images).mean(dim=(1, 2, 3))

    found, predictions = ready(Uncopied(), images[:1].float())
    assert found.name == "eager"
    torch.testing.assert_close(next(found.run([images[:1].float()])), predictions)
    with pytest.raises(ModelError, match=r"the engine folded cannot run Uncopied \(holds a file\); choose another"):
        ready(Uncopied(), images[:1].float(), engine="folded")


def test_a_network_with_hooks_runs_as_it_is(float_network, images):
    float_network.stage3.register_forward_hook(lambda _module, _arguments, output: 2 * output)
    assert ready(float_network, images[:1].float())[0].name == "eager"
    with pytest.raises(InputError, match="the engine openvino cannot be used: the model has hooks"):
        ready(float_network, images[:1].float(), engine="openvino")


def test_what_an_engine_needs_is_told(float_network, images, monkeypatch):
    with pytest.raises(InputError, match=r"cannot be used: it runs float32, not torch\.float64"):
        ready(float_network.double(), images[:1], engine="openvino")
    monkeypatch.setattr("sliplens.extras.find_spec", lambda _: None)
    with pytest.raises(InputError, match="it needs openvino, which is not installed; install with `pip install"):
        ready(float_network.float(), images[:1].float(), engine="openvino")
    assert ready(float_network, images[:1].float())[0].name == "folded"
    with pytest.raises(InputError, match="there is no engine named 'tvm'; choose one of eager, folded, compiled"):
        ready(float_network, images[:1].float(), engine="tvm")
