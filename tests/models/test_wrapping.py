"""Any PyTorch module with one output an image is predicted, explained and scored as a network of sliplens."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import torchvision
from captum.attr import DeepLift
from PIL import Image
from small import Returning
from torch import Tensor, nn

import sliplens as sl
from sliplens.errors import ModelError, SliplensError
from sliplens.explainers import attribution
from sliplens.explainers.table import get_explainer
from sliplens.faithfulness import controls
from sliplens.models.wrapping import Output

SIZE = 16
METHODS = ("grad-cam", "integrated-gradients", "smooth-grad", "occlusion", "shapley")
FAST = {"occlusion": {"tile_px": 4}, "shapley": {"tile_px": 8}, "smooth-grad": {"samples": 2}}


def small_module(outputs: int = 1, *, inplace: bool = False, seed: int = 0) -> nn.Module:
    torch.manual_seed(seed)
    return nn.Sequential(
        nn.Conv2d(3, 4, 3, padding=1), nn.ReLU(inplace=inplace), nn.Conv2d(4, 4, 3, stride=2), nn.ReLU(inplace=inplace),
        nn.Flatten(), nn.Linear(4 * 7 * 7, outputs),
    ).eval()  # fmt: skip


@pytest.fixture
def frames() -> np.ndarray:
    return np.random.default_rng(0).integers(256, size=(3, SIZE, SIZE, 3), dtype=np.uint8)


def images_of(frames: np.ndarray) -> Tensor:
    return torch.from_numpy(frames).permute(0, 3, 1, 2) / 255


@pytest.mark.parametrize(
    ("make", "output"),
    [
        (lambda values: values[:, 1], None),
        (lambda values: values[:, 1:2], None),
        (lambda values: values, 1),
        (lambda values: (values[:, 0], values[:, 1]), 1),
        (lambda values: (values[:, 1],), None),
        (lambda values: {"fx": values[:, 0], "fy": values[:, 1]}, "fy"),
        (lambda values: values, lambda values: values[:, 1]),
        (lambda values: values, partial(torch.select, dim=1, index=1)),
    ],
    ids=["vector", "column", "columns", "tuple", "tuple of one", "dict", "function", "partial"],
)
def test_one_of_several_outputs_is_predicted(frames: np.ndarray, make: Callable, output: Output | None):
    module = small_module(3)
    network = sl.wrap(Returning(make, module), size=SIZE, output=output)
    with torch.no_grad():
        expected = module(images_of(frames))[:, 1]
    table = sl.predict(network, frames).to_arrow()
    np.testing.assert_allclose(table["prediction"].to_numpy(), expected.numpy(), atol=1e-6)


@pytest.mark.parametrize(
    "change",
    [
        lambda module: module,
        lambda _: small_module(inplace=True),
        lambda module: module.double(),
        lambda module: module.to(memory_format=torch.channels_last),
        lambda module: torch.compile(module, backend="eager"),
    ],
    ids=["plain", "in place", "float64", "channels last", "compiled"],
)
def test_every_method_explains_and_adds_up(frames: np.ndarray, change: Callable):
    network = sl.wrap(change(small_module()), size=SIZE)
    explainers = [get_explainer(name, **FAST.get(name, {})) for name in METHODS]
    explanation = sl.explain(network, frames, method=explainers)
    assert tuple(explanation.methods) == METHODS
    change_of = [frame.prediction - frame.reference_prediction for frame in explanation.frames]
    for name in ("integrated-gradients", "shapley"):  # complete by their definition
        sums = explanation.relevance[name].sum(axis=(1, 2))
        np.testing.assert_allclose(sums, change_of, atol=0.011 * np.abs(change_of).max())


def test_the_unit_of_the_output_does_not_change_the_verdict(frames: np.ndarray):
    module = small_module()
    scaled = Returning(lambda values: 1000 * values, module)
    results = []
    for each in (module, scaled):
        network = sl.wrap(each, size=SIZE, unit="N")
        explanation = sl.explain(network, frames, method="integrated-gradients")
        results.append((explanation, sl.score(network, explanation, random_orders=2)))
    (maps, score), (large_maps, large_score) = results
    np.testing.assert_allclose(large_maps.relevance["integrated-gradients"], 1000 * maps.relevance["integrated-gradients"], rtol=1e-3, atol=1e-4)  # fmt: skip  # noqa: E501
    gain, large_gain = (each.score("integrated-gradients").srg.estimate for each in (score, large_score))
    assert large_gain == pytest.approx(1000 * gain, rel=1e-3)
    assert [alarm.split(":")[0] for alarm in large_score.alarms] == [alarm.split(":")[0] for alarm in score.alarms]
    assert "1000" not in maps.summary
    assert " N " in maps.summary
    assert " N" in score.summary


@pytest.mark.filterwarnings("ignore:Setting forward, backward hooks")
def test_maps_of_captum_are_scored_with_controls(frames: np.ndarray):
    module = small_module()
    network = sl.wrap(module, size=SIZE)
    images = images_of(frames).requires_grad_()
    maps = DeepLift(module).attribute(images, baselines=torch.zeros_like(images)).sum(dim=1)
    score = sl.score(network, frames, maps.detach().numpy(), random_orders=2)
    assert sl.score(network, torch.from_numpy(frames), maps, random_orders=2).scores == score.scores
    assert score.score("maps").srg.estimate > 0
    assert any(each.control for each in score.scores)


@pytest.mark.parametrize("baseline", ["black", "mean", "blurred"])
def test_baselines_without_a_reference(frames: np.ndarray, baseline: str):
    network = sl.wrap(small_module(), size=SIZE)
    explanation = sl.explain(network, frames, method="integrated-gradients", baseline=baseline)
    assert explanation.baseline == baseline
    images = images_of(frames)
    expected = {"black": torch.zeros_like(images), "mean": images.mean(dim=(0, 2, 3), keepdim=True).expand_as(images)}
    if baseline in expected:  # within half a grey level
        np.testing.assert_allclose(explanation.references / 255, expected[baseline].numpy(), atol=0.51 / 255)
    else:
        assert explanation.references.std(axis=(2, 3)).max() < explanation.images.std(axis=(2, 3)).min()


def test_a_module_goes_in_without_wrapping():
    module = nn.Sequential(nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(48, 1)).eval()
    frames = np.full((1, 20, 30, 3), 120, dtype=np.uint8)
    preprocess = torchvision.transforms.Normalize([0.5] * 3, [0.25] * 3)
    with torch.no_grad():
        expected = float(module(preprocess(torch.full((1, 3, 224, 224), 120 / 255))))
    [prediction] = sl.predict(module, frames, preprocess=preprocess).to_arrow()["prediction"].to_pylist()
    assert prediction == pytest.approx(expected, abs=1e-5)
    explanation = sl.explain(module, frames, preprocess=preprocess, method="integrated-gradients")
    assert explanation.frames[0].prediction == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("module", "options", "cure"),
    [
        (nn.Sequential(small_module(), nn.BatchNorm1d(1)).train(), {}, r"module\.eval\(\)"),
        (nn.Sequential(small_module(), nn.Dropout()).train(), {}, r"module\.eval\(\)"),
        (small_module(3), {}, "output=0"),
        (Returning(lambda values: (values[:, 0], values[:, 1]), small_module(2)), {}, "output=0"),
        (Returning(str, small_module()), {}, "output="),
        (small_module(), {"size": 32}, "size="),
        (small_module(), {"size": 0}, "size is 0; give"),
        (small_module(2), {"output": 5}, "size=|output="),
        (small_module(), {"encoding": "rgbd"}, "rgb"),
        (Returning(lambda values: {"fx": values}, small_module(2)), {"output": "fy"}, r"KeyError: 'fy'.*output="),
    ],
)
def test_what_cannot_be_wrapped_is_refused_with_its_cure(module: nn.Module, options: dict, cure: str):
    with pytest.raises(SliplensError, match=cure):
        sl.wrap(module, **{"size": SIZE, **options})


@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.parametrize(
    ("change", "methods", "cure"),
    [
        (torch.jit.script, ("grad-cam", "poly-cam"), "the module that it was made of"),
        (
            lambda module: torch.ao.quantization.quantize_dynamic(module, {nn.Linear}),
            ("integrated-gradients", "shapley", "smooth-grad"),
            "before it is quantised",
        ),
    ],
    ids=["TorchScript", "quantised"],
)
def test_modules_without_layers_or_gradients_are_refused_or_take_occlusion(
    frames: np.ndarray, change: Callable, methods: tuple[str, ...], cure: str
):
    network = sl.wrap(change(nn.Sequential(nn.Flatten(), nn.Linear(3 * SIZE**2, 1)).eval()), size=SIZE)
    for method in methods:
        with pytest.raises(ModelError, match=cure):
            sl.explain(network, frames[:1], method=method)
    explanation = sl.explain(network, frames[:2], method="occlusion")
    assert sl.score(network, explanation, random_orders=1, steps=0).frames == 2


class OnDevice(Tensor):
    """Tensor on a device without float64; what is computed from it stays there until `cpu`."""

    @classmethod
    def __torch_function__(cls, func: Callable, types: tuple, args: tuple = (), kwargs: dict | None = None) -> object:
        result = super().__torch_function__(func, types, args, kwargs or {})
        if func is Tensor.cpu and isinstance(result, Tensor):
            return result.as_subclass(Tensor)
        if isinstance(result, OnDevice) and result.dtype == torch.float64:
            raise TypeError("the device has no float64")
        return result


@pytest.mark.filterwarnings("ignore:Setting forward, backward hooks")
def test_methods_and_measures_do_without_float64(frames: np.ndarray, monkeypatch: pytest.MonkeyPatch):
    module, images = small_module(), images_of(frames)[:2]
    on_device = images.as_subclass(OnDevice)
    with pytest.raises(TypeError, match="no float64"):
        get_explainer("integrated-gradients")(module, on_device)
    monkeypatch.setattr(attribution, "lacks_float64", lambda _: True)
    explainers = [get_explainer(name, **FAST.get(name, {})) for name in METHODS]
    maps = [explainer(module, on_device).relevance for explainer in explainers]
    for explainer, relevance in zip(explainers, maps, strict=True):
        np.testing.assert_allclose(relevance.cpu().numpy(), explainer(module, images).relevance.numpy(), atol=1e-5)
    relevance = maps[0]
    measured = controls.infidelity(module, on_device, 0 * on_device, relevance)
    np.testing.assert_allclose(measured, controls.infidelity(module, images, 0 * images, relevance.cpu()), rtol=1e-4)
    assert np.isfinite(controls.max_sensitivity(lambda inputs: inputs.mean(dim=1), on_device)).all()


def test_predictions_are_written_in_the_unit_of_the_output(frames: np.ndarray):
    predictions = sl.predict(sl.wrap(small_module(), size=SIZE, unit="N"), frames)
    values = predictions.to_arrow()["prediction"].to_numpy()
    assert f"output {np.median(values):.3g} N (median)" in predictions.summary
    figure = sl.plot(predictions)
    assert "N" in figure.axes[0].get_ylabel()
    drawn = np.asarray(figure.axes[0].lines[0].get_ydata())
    np.testing.assert_allclose(drawn.astype(float), values)


def test_channels_last_maps_are_refused_by_the_cam_family(frames: np.ndarray):
    torch.manual_seed(0)
    network = sl.wrap(torchvision.models.swin_t(num_classes=1).eval(), size=32)
    for method in ("grad-cam", "poly-cam"):
        with pytest.raises(ModelError, match="integrated-gradients"):
            sl.explain(network, frames[:1], method=method)


def test_an_explanation_names_the_weights_of_its_module(frames: np.ndarray):
    explanation = sl.explain(sl.wrap(small_module(), size=SIZE), frames, method="integrated-gradients")
    with pytest.raises(SliplensError, match="another network"):
        sl.score(sl.wrap(small_module(seed=1), size=SIZE), explanation)
    outputs = [sl.wrap(small_module(3), size=SIZE, output=output) for output in (0, 2)]
    with pytest.raises(SliplensError, match="another network"):
        sl.score(outputs[0], sl.explain(outputs[1], frames, method="integrated-gradients"))
    same = sl.wrap(small_module(), size=SIZE)
    assert sl.score(replace(same), explanation, random_orders=1, steps=0).frames == len(frames)


def write_array(image: np.ndarray, path: Path) -> Path:
    np.savez(path, untouched=image) if path.suffix == ".npz" else np.save(path, image)
    return path


def write_image(image: np.ndarray, path: Path) -> Path:
    Image.fromarray(image).save(path)
    return path


@pytest.mark.parametrize(
    ("form", "reference_only"),
    [
        (lambda image, folder: write_image(image, folder / f"{image.sum()}.png"), False),
        (lambda image, folder: str(write_image(image, folder / f"{image.sum()}.bmp")), False),
        (lambda image, _: Image.fromarray(image), False),
        (lambda image, _: torch.from_numpy(image).permute(2, 0, 1), False),
        (lambda image, folder: write_array(image, folder / "untouched.npy"), True),
        (lambda image, folder: str(write_array(image, folder / "untouched.npz")), True),
        (lambda image, _: [image], True),
    ],
    ids=["path", "text", "Pillow", "tensor", "npy", "npz", "list"],
)
def test_frames_and_reference_of_every_form_are_the_same(
    frames: np.ndarray, form: Callable, reference_only: bool, tmp_path: Path
):
    network = sl.wrap(small_module(), size=SIZE, encoding="difference")
    images, untouched = frames[1:], frames[0]
    given = images if reference_only else [form(image, tmp_path) for image in images]
    results = []
    for shown, reference in ((images, untouched), (given, form(untouched, tmp_path))):
        options = {"reference": reference}
        maps = sl.explain(network, shown, method="integrated-gradients", baseline=reference, **options)
        score = sl.score(network, shown, maps.relevance["integrated-gradients"], random_orders=1, steps=0, **options)
        table = sl.predict(network, shown, **options).to_arrow()
        results.append((table["prediction"].to_pylist(), maps.relevance["integrated-gradients"].tolist(), score.scores))
    assert results[0] == results[1]
