"""The outputs of modules inside a network, taken while it runs and without a trace."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

from torch import Tensor, nn


@contextmanager
def capture(model: nn.Module, names: Sequence[str], *, differentiable: bool = False) -> Iterator[dict[str, Tensor]]:
    """Keep the output of each named module of every forward pass made inside, and always take the hooks off again.

    Parameters
    ----------
    model
        Network to listen to.
    names
        Modules, by their names in `model.named_modules()`. Of a module called twice the last output is kept.
    differentiable
        Start the graph anew at each kept output, so that the gradient of the prediction with respect to it can be
        taken and the backward pass stops there. With several modules only the last one's gradient is whole.

    Yields
    ------
    dict[str, Tensor]
        Outputs by name, filled by the forward pass.
    """
    outputs: dict[str, Tensor] = {}
    modules = dict(model.named_modules())

    def listen(name: str):  # noqa: ANN202 (a hook, typed by torch)
        def hook(_module: nn.Module, _arguments: object, output: Tensor) -> Tensor:
            outputs[name] = output.detach().requires_grad_(differentiable)
            # the rest of the network gets a copy: an in-place ReLU would overwrite what is kept
            return outputs[name].clone()

        return hook

    with ExitStack() as stack:
        for name in names:
            stack.callback(modules[name].register_forward_hook(listen(name)).remove)
        yield outputs
