#include "batch/rollout_impl.hpp"

namespace gelflow {
template class Batch<float>;
}  // namespace gelflow
