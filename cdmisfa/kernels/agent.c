/* The curious agent: statistics of a block, saving, rewards, and the choice of the next stream. */

static const double TIE = 1e-12;         /* relative gain up to which two values count as equal */
static const double IDLE_EPSILON = 1e-3; /* epsilon below which the agent practically exploits */

enum { MAX_SWEEPS = 100 }; /* of policy iteration, which takes a few; rounding could make a cycle */

/* Update slowness, its change, and the gate's statistics with output j on a block; the block is
 * counted among the novel ones already, its frames are not. */
static void track_output(const agent *a, int64_t j, const double *y) {
  const rules *r = a->rules;
  int64_t blocks = a->memory->novel_blocks;
  double n = (double)a->tau, frames = (double)*a->y_frames + n;
  moments now = moments_of(y + j, a->tau, a->outputs);
  double square = fused(now.mean, now.mean, now.variance);
  double rate = larger(2 * n / (r->slowness_window + n), 1 / (double)blocks);
  if (rate > 1) rate = 1;
  a->derivative[j] += rate * (now.derivative - a->derivative[j]);
  a->recent_mean[j] += rate * (now.mean - a->recent_mean[j]);
  a->recent_square[j] += rate * (square - a->recent_square[j]);
  a->y_sum[j] += now.mean * n;
  a->square_sum[j] += square * n;
  double mean = a->y_sum[j] / frames;
  double eta = slowness(a->derivative[j], a->square_sum[j] / frames - mean * mean);
  double change = fabs(eta - a->eta[j]);
  a->eta[j] = eta;
  if (isnan(a->eta_dot[j])) a->eta_dot[j] = change;
  else a->eta_dot[j] += 2 / (r->eta_dot_window + 1) * (change - a->eta_dot[j]);
  a->eta_inst[j] = slowness(now.derivative, now.variance);
  if (a->eta_inst[j] == INFINITY) return; /* a constant output has no slowness to average */
  double weight = window_rate(r->gate_window, blocks), step = a->eta_inst[j] - a->gate_mean[j];
  a->gate_mean[j] += weight * step;
  a->gate_variance[j] = (1 - weight) * (a->gate_variance[j] + weight * step * step);
}

/* Whether the slowness of every output has stopped changing.
 *
 * Equation: 3
 */
static bool converged(const double *eta_dot, int64_t J, double delta) {
  for (int64_t j = 0; j < J; j++)
    if (!(fabs(eta_dot[j]) < delta)) return false;
  return true;
}

/* Whether the output has settled and varies, and the agent stays with novel blocks of a stream. */
static bool ready_to_save(const agent *a) {
  const memory *m = a->memory;
  const rules *r = a->rules;
  if ((double)m->novel_blocks <= r->eta_dot_window || m->share < r->novel_share) return false;
  for (int64_t j = 0; j < a->outputs; j++)
    if (a->recent_square[j] - a->recent_mean[j] * a->recent_mean[j] < r->min_variance) return false;
  return r->tabular ? m->roc_error < r->roc_error : converged(a->eta_dot, a->outputs, r->delta);
}

/* Beta times the Gaussian Z of the mean weight change; sigma 0 switches it off.
 *
 * Equation: 5
 */
static double expert_reward(double xi, double sigma, double beta) {
  return sigma <= 0 ? 0 : beta * exp_of(-xi * xi / (2 * sigma * sigma));
}

/* Decrease of the mean weight change since the previous novel block.
 *
 * Equation: 5
 */
static double curiosity_reward(double xi, double xi_before) { return -(xi - xi_before); }

/* The entry of the tensor of rewards for the last transition, which led to a stream. */
static double *last_entry(const agent *a, int64_t stream) {
  return a->dense + (2 * a->memory->last_stream + a->memory->last_action) * a->streams + stream;
}

/* Add the reward of the last transition to the sums; divided by their count t, these are R.
 *
 * R <- R~/t + (1 - 1/t) R, where R~ is zero except for the entry (s, a, s'), is the mean over all
 * rewarded iterations: sum / t. The sums that the policy needs are stored, and the whole tensor if
 * it is small.
 *
 * Equation: 6
 */
static void add_reward(const agent *a, int64_t stream, double reward) {
  const memory *m = a->memory;
  (m->last_action ? a->switch_sum : a->stay_sum)[m->last_stream] += reward;
  if (a->tensor) *last_entry(a, stream) += reward;
}

/* CD-MISFA 1.0: move the entry (s, a, s') towards the reward; return the norm of the tensor.
 *
 * R~(s,a,s') <- alpha r + (1 - alpha) R~(s,a,s'), R = R~ / |R~|. The other entries do not change,
 * which makes 1.0 unstable (paper, CD-MISFA 1.0 vs CD-MISFA 2.0 (b)).
 */
static double add_reward_locally(const agent *a, int64_t stream, double reward) {
  int64_t S = a->streams, s = a->memory->last_stream;
  double *entry = last_entry(a, stream), *stay = a->dense + 2 * s * S, *leave = stay + S;
  *entry += a->rules->alpha * (reward - *entry);
  a->stay_sum[s] = stay[s];
  a->switch_sum[s] = 0;
  for (int64_t to = 0; to < S; to++) a->switch_sum[s] += leave[to];
  return sqrt(dot(a->dense, a->dense, 2 * S * S));
}

/* Sum T of the values of all streams under the policy.
 *
 * Stay leads from s to s; switch leads to each other stream with probability 1/(n-1). The values of
 * a policy obey V(s) = r_stay(s) / (1 - gamma) where it stays, and where it switches
 * V(s) = r_switch(s) + gamma (T - V(s)) / (n-1), with one unknown T. A common factor of R does not
 * change the policy, so its sums are used instead.
 */
static double value_sum(const agent *a) {
  const double *stay = a->stay_sum, *leave = a->switch_sum;
  const int64_t *policy = a->policy;
  double gamma = a->rules->gamma, n = (double)a->streams, horizon = (n - 1 + gamma) / (1 - gamma);
  lanes totals[4] = {0};
  whole_lanes leaving = {0};
  int64_t s = 0;
  for (; s + 4 * LANES <= a->streams; s += 4 * LANES)
#pragma GCC unroll 4
    for (int i = 0; i < 4; i++) {
      int64_t at = s + i * LANES;
      whole_lanes leaves = (whole_lanes)(load_whole(policy + at) == 1);
      totals[i] += choose(leaves, load(leave + at), load(stay + at) * horizon);
      leaving -= leaves;
    }
  double total = sum((totals[0] + totals[1]) + (totals[2] + totals[3]));
  int64_t leavers = leaving[0] + leaving[1] + leaving[2] + leaving[3];
  for (; s < a->streams; s++) {
    total += policy[s] == 1 ? leave[s] : stay[s] * horizon;
    leavers += policy[s] == 1;
  }
  /* This form has no cancellation if every stream is left and gamma is close to 1. */
  return total / (n - (double)leavers + (double)(leavers - 1) * (1 - gamma));
}

/* Make the policy greedy for its values; return whether the action of any stream changed.
 *
 * With V(s) the values of s if it is left and if it stays, leaving is better under either policy if
 * the first is greater.
 */
static bool improve(const agent *a) {
  const double *stay = a->stay_sum, *leave = a->switch_sum;
  int64_t *policy = a->policy, S = a->streams, changed = 0;
  double gamma = a->rules->gamma, mean = 1 / (double)(S - 1), share = gamma / (double)(S - 1);
  double arriving = share * value_sum(a), damp = 1 / (1 + share), horizon = 1 / (1 - gamma);
  whole_lanes differ = {0};
  int64_t s = 0;
  for (; s + LANES <= S; s += LANES) {
    lanes kept = load(stay + s) * horizon, left = (load(leave + s) * mean + arriving) * damp;
    lanes least = TIE * (absolute(left) + absolute(kept));
    whole_lanes better = (whole_lanes)(left - kept > least) & 1;
    differ |= better ^ load_whole(policy + s);
    *(whole_lanes *)(policy + s) = better;
  }
  changed = differ[0] | differ[1] | differ[2] | differ[3];
  for (; s < S; s++) {
    double kept = stay[s] * horizon, left = (leave[s] * mean + arriving) * damp;
    int64_t better = left - kept > TIE * (fabs(left) + fabs(kept));
    changed |= better ^ policy[s];
    policy[s] = better;
  }
  return changed != 0;
}

/* Values Q (S, 2) of both actions in every stream under the agent's policy. */
void action_values(const agent *a, double *Q) {
  double gamma = a->rules->gamma, horizon = 1 / (1 - gamma), others = (double)(a->streams - 1);
  double count = a->memory->scale > 0 ? a->memory->scale : 1; /* before any reward all sums are 0 */
  double share = others > 0 ? gamma / others : 0, damp = 1 / (1 + share);
  double arriving = others > 0 ? share * value_sum(a) / count : 0;
  const double *stay = a->stay_sum, *leave = a->switch_sum;
  const int64_t *policy = a->policy;
  for (int64_t s = 0; s < a->streams; s++) {
    double reward = stay[s] / count, arrive = leave[s] / (count * others) + arriving;
    double left = arrive * damp, kept = reward * horizon, value = policy[s] == 1 ? left : kept;
    Q[2 * s] = reward + gamma * value;
    Q[2 * s + 1] = arrive - share * value;
  }
  if (a->streams == 1) Q[1] = Q[0];
}

/* Update R with the reward of the last transition, and improve the policy until it is optimal for
 * R; ties go to stay. */
static void estimate_reward(const agent *a, double reward) {
  memory *m = a->memory;
  m->rewards++;
  if (a->rules->tabular) {
    m->scale = add_reward_locally(a, m->stream, reward);
  } else {
    add_reward(a, m->stream, reward);
    m->scale = (double)m->rewards;
  }
  if (a->streams == 1) a->policy[0] = 0;
  else if (m->scale > 0)
    for (int k = 0; k < MAX_SWEEPS && improve(a); k++) continue;
}

/* Choose the next stream by decaying epsilon-greedy: epsilon shrinks by one factor above the knee
 * and by another below (paper, Oscillatory Streams Environment); a switch leads to each other
 * stream with the same probability.
 *
 * uniforms: three draws from [0, 1): whether to explore, the random action, the stream.
 */
static void act(const agent *a, const double *uniforms) {
  const rules *r = a->rules;
  memory *m = a->memory;
  outcome *o = a->out;
  int64_t others = a->streams - 1;
  double decay = m->epsilon > r->epsilon_knee ? r->epsilon_decay : r->epsilon_tail_decay;
  o->epsilon = m->epsilon = o->saved ? r->epsilon_start : m->epsilon * decay;
  o->explored = uniforms[0] < m->epsilon;
  o->action = o->explored ? uniforms[1] >= 0.5 : !o->saved && a->policy[m->stream] == 1;
  o->next_stream = m->stream;
  if (o->action && others) {
    int64_t ahead = smaller((int64_t)(uniforms[2] * (double)others), others - 1);
    o->next_stream = (m->stream + 1 + ahead) % a->streams;
  }
  m->idle = m->epsilon < IDLE_EPSILON ? m->idle + 1 : 0;
  m->last_stream = m->stream;
  m->last_action = o->action;
  m->stream = o->next_stream;
}

/* Mean weight change over the frames of a block, without the first one after a gap. */
static double mean_change(const double *xi, int64_t n) {
  double total = 0;
  int64_t count = 0;
  for (int64_t t = 0; t < n; t++) {
    total += isnan(xi[t]) ? 0 : xi[t];
    count += !isnan(xi[t]);
  }
  return count ? total / (double)count : NAN;
}

/* Compute the reward of a novel block that ends before frame t, and whether to save. */
static void judge(const agent *a, double xi, const double *y, int64_t t) {
  memory *m = a->memory;
  outcome *o = a->out;
  m->novel_blocks++;
  o->xi = xi;
  if (m->novel_blocks > 1) o->xi_dot = xi - m->xi;
  if (m->novel_blocks > 1 && (double)m->novel_blocks > a->rules->warm_up && m->last_stream >= 0) {
    o->curiosity = curiosity_reward(xi, m->xi);
    o->expert = expert_reward(xi, a->rules->sigma, a->rules->beta);
    o->reward = o->curiosity + o->expert;
  }
  m->xi = xi;
  m->fed_stream = m->stream;
  m->fed_until = t;
  for (int64_t j = 0; j < a->outputs; j++) track_output(a, j, y);
  *a->y_frames += a->tau;
  if (a->rules->tabular) o->roc_error_inst = track_clusters(a, m->stream, y);
  o->saved = ready_to_save(a);
}

/* One iteration after the result of the gate and the update of the features.
 *
 * xi (n,): weight change at each frame of the block, which begins at frame t; y (n, J): its
 * outputs; both are unused unless the block is novel. If `saved` is true afterwards, the caller
 * saves the features and begins new ones; the statistics are still those of the saved features.
 */
int think(const agent *a, const double *xi, const double *y, int64_t t, const double *uniforms) {
  memory *m = a->memory;
  outcome *o = a->out;
  if (!is_state(a)) return NOT_A_STATE;
  bool novel = o->known_by == NOVEL;
  double stayed = novel && m->last_stream == m->stream;
  *o = (outcome){.stream = m->stream, .module = m->module, .novel = novel, .known_by = o->known_by,
                 .roc_error_inst = NAN, .xi = NAN, .xi_dot = NAN, .curiosity = NAN, .expert = NAN,
                 .reward = NAN};
  m->share += (stayed - m->share) * 2 / (a->rules->eta_dot_window + 1);
  if (novel) judge(a, mean_change(xi, a->tau), y, (int64_t)((uint64_t)t + (uint64_t)a->tau));
  o->share = m->share;
  o->novel_blocks = m->novel_blocks;
  o->roc_error = m->roc_error;
  if (!o->saved && !isnan(o->reward)) estimate_reward(a, o->reward);
  act(a, uniforms);
  m->iteration++;
  return 0;
}

/* One iteration: ask the gate, learn if the block is novel, think; y is NaN if it is not novel. */
int iterate(const agent *a, const frozen *f, const incsfa *feature, const frames *shown,
            const frames *x, int64_t t, const double *uniforms, double *y, double *y_frozen,
            double *eta_inst, double *roc_error) {
  const memory *m = a->memory;
  double *xi = malloc((size_t)(a->tau + a->outputs) * sizeof *xi);
  if (!xi) return NO_MEMORY;
  for (int64_t i = 0; i < a->tau * a->outputs; i++) y[i] = NAN;
  int code = recognise(a, f, shown, x, y_frozen, eta_inst, roc_error);
  bool novel = code == 0 && a->out->known_by == NOVEL;
  if (novel) code = incsfa_update(feature, x, m->fed_stream != m->stream || m->fed_until != t, xi);
  if (novel && code == 0) {
    double *offset = xi + a->tau;
    mean_output(a->outputs, x->size, feature->phi, feature->mean, offset);
    code = outputs(a->outputs, feature->phi, offset, x, y);
  }
  if (code == 0) code = think(a, xi, y, t, uniforms);
  free(xi);
  return code;
}

/* Frames [first, first + n) of a table. */
static frames frames_from(const frames *x, int64_t first, int64_t n) {
  int64_t at = first * x->size;
  return (frames){n, x->size, x->pixels ? x->pixels + at : NULL, x->values ? x->values + at : NULL};
}

/* Write iteration k into the curves of a trial. */
static void keep_curves(const agent *a, const curves *kept, int64_t k) {
  int64_t S = a->streams, J = a->outputs;
  double scale = a->memory->scale > 0 ? a->memory->scale : 1;
  kept->outcome[k] = *a->out;
  memcpy(kept->eta_dot + k * J, a->eta_dot, (size_t)J * sizeof *a->eta_dot);
  memcpy(kept->policy + k * S, a->policy, (size_t)S * sizeof *a->policy);
  for (int64_t s = 0; s < S; s++) kept->R[k * S + s] = a->stay_sum[s] / scale;
  action_values(a, kept->Q + 2 * k * S);
}

/* Do up to n iterations on periodic streams: until a module is ready to be saved, epsilon falls
 * below `swap_below`, or patience ends. Returns the number of iterations, or an error.
 *
 * shown, x: for each stream one period and the tau frames that follow, raw and expanded. uniforms
 * (n, 3) as in `act`. kept: null, or the curves to write.
 */
int64_t iterations(const agent *a, const frozen *f, const incsfa *feature, const frames *shown,
                   const frames *x, const double *uniforms, int64_t n, double swap_below,
                   const curves *kept) {
  memory *m = a->memory;
  int64_t M = f->modules, J = a->outputs, block = a->tau * J;
  int64_t done = 0, rows = shown->n / a->streams;
  double *y = malloc((size_t)((M + 1) * (block + J + 1)) * sizeof *y);
  if (!y) return NO_MEMORY;
  double *y_frozen = y + block, *eta_inst = y_frozen + M * block, *error = eta_inst + M * J;
  int code = is_state(a) ? 0 : NOT_A_STATE;
  for (bool over = false; done < n && !over && code == 0; done++) {
    int64_t t = m->iteration * a->tau, first = m->stream * rows + t % (rows - a->tau);
    frames seen = frames_from(shown, first, a->tau), expanded = frames_from(x, first, a->tau);
    code = iterate(a, f, feature, &seen, &expanded, t, uniforms + 3 * done, y, y_frozen, eta_inst,
                   error);
    if (code == 0 && kept) keep_curves(a, kept, done);
    over = a->out->saved || (double)m->idle > a->rules->patience || m->epsilon < swap_below;
  }
  free(y);
  return code ? code : done;
}

/* The work of some blocks that only one of the two algorithms does, for benchmarks: y (phases, n,
 * J) and y_frozen (phases, M, n, J) are outputs of features and modules; told (M, J) is scratch. */
void own_work(const agent *a, const frozen *f, int64_t blocks, int64_t phases, const double *y,
              const double *y_frozen, double *told) {
  memory *m = a->memory;
  for (int64_t k = 0; k < blocks; k++) {
    int64_t length = a->tau * a->outputs, first = k % phases * length;
    m->novel_blocks++;
    m->last_stream = k % a->streams;
    if (a->rules->tabular) {
      track_clusters(a, m->last_stream, y + first);
      known_to(a, f, m->last_stream, y_frozen + f->modules * first, told);
      add_reward_locally(a, m->last_stream, 0.001);
    } else {
      for (int64_t j = 0; j < a->outputs; j++) track_output(a, j, y + first);
      *a->y_frames += a->tau;
      verdict(a, f, y_frozen + f->modules * first, told);
      add_reward(a, m->last_stream, 0.001);
    }
  }
}
