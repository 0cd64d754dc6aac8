"""ELU, its slope and copies, in float32 and in bfloat16, against float64 and torch's own rounding."""

import numpy as np
import pytest
import torch

from common.policy.elementwise import elu, elu_gradient, place
from common.policy.network_pass import _bits

EVERY_BFLOAT16 = torch.arange(2**16, dtype=torch.int32).to(torch.uint16).view(torch.bfloat16)


def test_elu_of_every_bfloat16_is_rounded_to_the_nearest_one():
    inputs = EVERY_BFLOAT16[EVERY_BFLOAT16.isfinite()].reshape(-1, 256)
    outputs = torch.zeros(len(inputs), 300, dtype=torch.bfloat16)
    elu(_bits(inputs), _bits(outputs), inputs.shape[1])
    exact = torch.nn.functional.elu(inputs.double())
    got = outputs[:, :256].double()

    assert (outputs[:, 256:] == 0).all()
    positive = inputs > 0
    assert torch.equal(got[positive], inputs[positive].double())
    assert bool(
        ((got - exact).abs() <= exact.abs() * 2.0**-8 * 1.001 + 2.0**-133).all()
    )  # half of the last bit of 8


def test_elu_of_float32_is_exact_to_its_last_bits():
    inputs = torch.linspace(-120.0, 20.0, 100_000).reshape(-1, 100)
    outputs = torch.empty_like(inputs)
    elu(_bits(inputs), _bits(outputs), inputs.shape[1])

    np.testing.assert_allclose(outputs, torch.nn.functional.elu(inputs.double()), rtol=4e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_elu_of_nan_is_nan_and_of_infinity_infinity(dtype):
    inputs = torch.tensor([[float("nan"), float("inf"), -float("inf")]], dtype=dtype)
    outputs = torch.zeros_like(inputs)
    elu(_bits(inputs), _bits(outputs), inputs.shape[1])

    assert outputs[0, 0].isnan()
    assert outputs[0, 1:].tolist() == [float("inf"), -1.0]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.bfloat16, 2.0**-7)])
def test_elus_slope_is_autograds(dtype, tolerance):
    generator = torch.Generator().manual_seed(0)
    inputs = (3.0 * torch.randn(200, 48, generator=generator)).to(dtype)
    slope = torch.randn(200, 48, generator=generator).to(dtype)
    outputs = torch.zeros(200, 64, dtype=dtype)
    elu(_bits(inputs), _bits(outputs), inputs.shape[1])
    exact = inputs.double().requires_grad_()
    torch.nn.functional.elu(exact).backward(slope.double())
    elu_gradient(_bits(outputs), _bits(slope), 48)

    # an output near -1 has lost the small slope's digits
    np.testing.assert_allclose(slope.double(), exact.grad, atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_columns_are_copied_to_their_place_alone(dtype):
    source = torch.arange(12.0).reshape(3, 4).to(dtype)
    target = torch.full((5, 6), -1.0, dtype=dtype)
    place(_bits(source), 3, _bits(target), 2)

    assert torch.equal(target[:3, 2:5], source[:, :3])
    target[:3, 2:5] = -1.0
    assert (target == -1.0).all()
