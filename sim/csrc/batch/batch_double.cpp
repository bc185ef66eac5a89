#include "batch/rollout_impl.hpp"

namespace gelflow {
template class Batch<double>;
}  // namespace gelflow
