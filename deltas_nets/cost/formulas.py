"""How many operations each torch operator is, by one convention.

The unit is the floating-point operation (FLOP); a multiply-accumulate (MAC) is two.

- Convolutions and matrix products: as `torch.utils.flop_counter`, 2 per weight and output
  element; with a bias this is exact, without one it is an addition too many per element.
- Elementwise operators, comparisons, logic and choices (`where`) included: 1 per output
  element, whatever function and dtype. Those that fuse two arithmetic steps: 2.
- Reductions: 1 per input element; pooling: 1 per element of the window and output element.
- Bilinear sampling and resizing: 4 multiply-accumulates (8 FLOPs) per output element of each
  channel, one per neighbour; the arithmetic of the places themselves is not counted.
- Batch norm with fixed statistics: 2 per element (a scale and a shift). Norms that compute
  their statistics: 8. Softmax: 5 (maximum, subtraction, exponential, sum, division).
- Decompositions (LU, Cholesky, QR, SVD, eigenvectors): the textbook's leading terms.
- Views, copies, gathers, padding and constants: 0.
"""

from collections.abc import Callable, Iterable, Mapping
from math import ceil, log2, prod
from typing import Any

from torch import Tensor

Formula = Callable[[tuple[Any, ...], Mapping[str, Any], Any], int]
"""From an operator's arguments, keyword arguments and result to its FLOPs."""


def _elements(value: Any) -> int:
    """How many elements a tensor has, or the first of several."""
    first = value if isinstance(value, Tensor) else value[0]
    return int(first.numel())


def _per_output(flops: int) -> Formula:
    return lambda args, kwargs, out: flops * _elements(out)


def _per_input(flops: int) -> Formula:
    return lambda args, kwargs, out: flops * _elements(args[0])


def _batch_norm(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
    # The only bool says whether the statistics are of this batch, in all variants.
    of_batch = next(value for value in args if isinstance(value, bool))
    return (8 if of_batch else 2) * _elements(out)


def _pooling(dims: int) -> Formula:
    def formula(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
        window = args[1]  # one side where all are the same
        area = prod(window) if len(window) == dims else window[0] ** dims
        return int(area) * _elements(out)

    return formula


def _grid_sampler(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
    neighbours = 2 ** (args[0].ndim - 2)
    # Bicubic: four rows of four neighbours, then a column of four.
    macs = (neighbours, 0, 20)[int(args[2])]  # bilinear, nearest, bicubic
    return 2 * macs * _elements(out)


def _distances(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
    # Difference, square and sum of each coordinate, then the root.
    return (3 * int(args[0].shape[-1]) + 1) * _elements(out)


def _topk(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
    # Each element goes through a heap of the k best.
    return ceil(log2(max(2, args[1]))) * _elements(args[0])


def _sort(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
    dim = kwargs.get("dim", args[1] if len(args) > 1 else -1)
    length = args[0].shape[dim] if args[0].ndim else 1
    return ceil(log2(max(2, length))) * _elements(args[0])


def _index_put(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
    accumulates = args[3] if len(args) > 3 else kwargs.get("accumulate", False)
    return _elements(args[2]) if accumulates else 0


def _scattered(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
    return _elements(args[3])  # self, dim, index, source


def _of_square(cubes: float) -> Formula:
    """``cubes * n^3`` for each ``(n, n)`` matrix."""

    def formula(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
        rows = int(args[0].shape[-1])
        return round(cubes * rows * _elements(args[0]))

    return formula


def _solve(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
    rows = int(args[0].shape[-1])
    return round(2 / 3 * rows * _elements(args[0])) + 2 * rows * _elements(out)


def _solve_triangular(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
    return int(args[0].shape[-1]) * _elements(out)


def _svd(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
    # Golub and Van Loan, 4th ed., section 8.6: the algorithm of Golub and Reinsch.
    *batch, rows, columns = map(int, args[0].shape)
    m, n = max(rows, columns), min(rows, columns)
    given = dict(zip(("full_matrices", "compute_uv"), args[1:], strict=False)) | dict(kwargs)
    if not given.get("compute_uv", True):
        flops = 4 * m * n * n - 4 * n**3 // 3
    elif given.get("full_matrices", False):
        flops = 4 * m * m * n + 8 * m * n * n + 9 * n**3
    else:
        flops = 14 * m * n * n + 8 * n**3
    return prod(batch) * flops


def _qr(args: tuple[Any, ...], kwargs: Mapping[str, Any], out: Any) -> int:
    # Golub and Van Loan, 4th ed., section 5.2: Householder, then as much again for thin Q.
    *batch, m, n = map(int, args[0].shape)
    return prod(batch) * (4 * m * n * n - 4 * n**3 // 3)


def _table(groups: Iterable[tuple[str, Formula]]) -> dict[str, Formula]:
    return {name: formula for names, formula in groups for name in names.split()}


FORMULAS: dict[str, Formula] = _table(
    (
        (
            # Constants, copies, gathers, padding, questions about tensors. Views, which the
            # operators themselves declare, need no entry unless they work in place.
            "squeeze unsqueeze transpose t detach as_strided "
            "empty empty_like empty_strided empty_permuted new_empty new_empty_strided zeros "
            "zeros_like new_zeros ones ones_like new_ones full full_like new_full fill zero eye "
            "arange linspace scalar_tensor rand rand_like randn randn_like randint randperm "
            "uniform normal bernoulli clone copy _to_copy lift lift_fresh_copy _unsafe_view cat "
            "stack repeat constant_pad_nd reflection_pad1d reflection_pad2d replication_pad1d "
            "replication_pad2d pixel_shuffle pixel_unshuffle flip roll gather index "
            "index_select _unsafe_index index_copy index_fill scatter masked_scatter "
            "masked_select take slice_scatter select_scatter tril triu im2col "
            "upsample_nearest1d upsample_nearest2d _upsample_nearest_exact2d promote_types "
            "result_type _linalg_check_errors _local_scalar_dense resize set",
            lambda args, kwargs, out: 0,
        ),
        (
            "add sub rsub mul div reciprocal neg abs sign sgn square sqrt rsqrt pow exp exp2 "
            "expm1 log log1p log2 log10 sin cos tan asin acos atan atan2 sinh cosh tanh sigmoid "
            "log_sigmoid_forward erf relu relu6 leaky_relu hardtanh hardsigmoid elu gelu "
            "softplus threshold floor ceil round trunc frac remainder fmod floor_divide maximum "
            "minimum fmax fmin clamp clamp_min clamp_max eq ne lt le gt ge isnan isinf isfinite "
            "signbit copysign logical_and logical_or logical_not logical_xor bitwise_and "
            "bitwise_or bitwise_not bitwise_xor where masked_fill nan_to_num",
            _per_output(1),
        ),
        ("addcmul addcdiv xlogy silu hardswish mish hypot _prelu_kernel", _per_output(2)),
        ("lerp linalg_cross", _per_output(3)),
        ("_softmax _log_softmax", _per_output(5)),
        (
            "sum mean prod amax amin max min aminmax argmax argmin any all nansum nonzero "
            "count_nonzero equal cumsum cumprod _adaptive_avg_pool2d _adaptive_avg_pool3d",
            _per_input(1),
        ),
        ("linalg_vector_norm norm dot vdot", _per_input(2)),
        ("var std var_mean std_mean logsumexp", _per_input(4)),
        ("avg_pool2d max_pool2d_with_indices", _pooling(2)),
        ("avg_pool3d max_pool3d_with_indices", _pooling(3)),
        ("topk", _topk),
        ("sort", _sort),
        ("scatter_add scatter_reduce index_add index_reduce", _scattered),
        ("index_put _index_put_impl", _index_put),
        (
            "native_batch_norm cudnn_batch_norm miopen_batch_norm _native_batch_norm_legit",
            _batch_norm,
        ),
        ("_native_batch_norm_legit_no_training", _per_output(2)),
        ("native_layer_norm native_group_norm", _per_output(8)),
        ("grid_sampler_2d grid_sampler_3d", _grid_sampler),
        ("upsample_linear1d", _per_output(4)),
        ("upsample_bilinear2d cudnn_grid_sampler", _per_output(8)),
        ("upsample_trilinear3d", _per_output(16)),
        ("upsample_bicubic2d", _per_output(40)),
        ("_euclidean_dist _cdist_forward", _distances),
        ("_linalg_svd", _svd),
        ("_linalg_eigh", _of_square(9)),  # Golub and Van Loan, 4th ed., section 8.3
        ("linalg_inv_ex", _of_square(2)),
        ("_linalg_det linalg_lu_factor_ex", _of_square(2 / 3)),
        ("linalg_cholesky_ex cholesky", _of_square(1 / 3)),
        ("_linalg_solve_ex", _solve),
        ("linalg_solve_triangular", _solve_triangular),
        ("linalg_qr", _qr),
    )
)
"""By the operator's name without "aten::" and without the underscore of the in-place variant."""


def attention_softmax(query: Tensor, key: Tensor) -> int:
    """FLOPs of the softmax inside fused attention of ``(*B, N, D)`` over ``(*B, M, D)``."""
    return 5 * query.shape[:-1].numel() * int(key.shape[-2])


def attention_products(query: Tensor, key: Tensor, value: Tensor) -> int:
    """FLOPs of the products in fused attention, whose CPU kernel torch's counter leaves out."""
    width = int(query.shape[-1] + value.shape[-1])
    return 2 * query.shape[:-1].numel() * int(key.shape[-2]) * width
