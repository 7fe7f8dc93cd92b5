/* Declarations of everything that Python calls, and of its records; `build.py` reads this file too.
 *
 * Arrays are of doubles, in C order, and do not overlap; (n, I) means n rows of I numbers.
 * `__init__.py` checks their sizes and types; C does not. A function that returns an int returns 0,
 * or one of these:
 */
enum {
  NO_MEMORY = -1, /* memory for intermediate results could not be allocated */
  NOT_A_STATE = -2, /* an index in the state is out of range */
  OUT_OF_ORDER = -3 /* a chunk contradicts its index, or the layout of its messages */
};

/* Frames as rows: pixels, which count 1/255 each, or values; the other pointer is null. */
typedef struct {
  int64_t n, size;
  const uint8_t *pixels;
  const double *values;
} frames;

/* Whether this processor has AVX2 and FMA, for which one of the two modules is compiled. */
int has_wide_lanes(void);

/* lanes.h */
void multiply(int64_t rows, int64_t parts, int64_t width, const double *a, int64_t a_row,
              const double *b, int64_t b_row, double *c, int64_t c_row);

/* elementary.c */
double exp_of(double x);
double log_of(double x);
void sines(const double *x, int64_t n, double *out);
void cosines(const double *x, int64_t n, double *out);
int64_t normals(const uint64_t *words, int64_t n_words, double *out, int64_t n);

/* projection.c: phi (rows, I), offset (rows,), y (n, rows) */
int outputs(int64_t rows, const double *phi, const double *offset, const frames *x, double *y);
void mean_output(int64_t rows, int64_t size, const double *phi, const double *mean, double *offset);

/* incsfa.c: I inputs, K components, J outputs */
enum { MANY_INPUTS = 200 }; /* number of inputs from which `incsfa_update` uses the Gram matrix,
                               which is then faster; both ways differ in the last bits */
typedef struct {
  int64_t inputs, components, outputs;
  double nu, window;  /* learning rate of MCA, window of the running mean (frames) */
  double *mean;       /* (I,) */
  double *v, *d;      /* (K, I) CCIPCA vectors, (K,) their lengths */
  double *gram;       /* (K, K) inner products of v; stored for many inputs only */
  double *w, *z_prev; /* (J, K) MCA rows, (K,) previous frame, whitened */
  double *phi;        /* (J, I) slow features */
  int64_t *counts;    /* (3,) frames; 1 after a gap; frames since `gram` was computed */
} incsfa;
int incsfa_update(const incsfa *state, const frames *x, int gap, double *xi);
int incsfa_by_frame(const incsfa *state, const frames *x, int gap, double *xi);
int incsfa_by_gram(const incsfa *state, const frames *x, int gap, double *xi);

/* The agent: S streams, J outputs, M saved modules; agents/agent.py describes the fields. */
enum { NOVEL = 0, CONSTANT = -1 }; /* results of the gate if no module explains a block */

typedef struct {
  int64_t iteration, module, stream, last_stream, last_action, fed_stream, fed_until;
  int64_t novel_blocks, rewards;
  double scale, roc_error, xi, share, epsilon;
  int64_t idle;
} memory;

typedef struct {
  int64_t stream, module;
  bool novel;
  int64_t known_by;
  bool saved;
  double share;
  int64_t novel_blocks;
  double roc_error, roc_error_inst, xi, xi_dot, curiosity, expert, reward, epsilon;
  bool explored;
  int64_t action, next_stream;
} outcome;

typedef struct {
  double sigma, beta, delta, gamma, epsilon_start, epsilon_decay, epsilon_knee, epsilon_tail_decay;
  double slowness_window, eta_dot_window, gate_window, warm_up, min_variance, novel_share;
  double alpha, roc_radius, roc_memory, roc_error, patience;
  int64_t tabular;
} rules;

typedef struct {
  int64_t streams, outputs, tau; /* S, J, frames in a block */
  int64_t tensor, places;        /* S if `dense` is stored, else 0; centres of each stream, or 0 */
  const rules *rules;
  outcome *out;
  memory *memory;
  double *eta, *eta_dot, *eta_inst, *gate_mean, *gate_variance, *derivative; /* (J,) */
  double *y_sum, *square_sum;                                                /* (J,) */
  int64_t *y_frames;                                                         /* (1,) */
  double *recent_mean, *recent_square;                                       /* (J,) */
  double *stay_sum, *switch_sum, *dense;                                     /* (S,), (S, 2, S) */
  int64_t *policy;                                                           /* (S,) */
  double *centres, *counts; /* (S, places, tau, J), (S, places) */
} agent;

typedef struct {
  int64_t modules, inputs;
  double *phi, *offset;        /* (M J, I), (M J,) */
  double *band_mean, *band_sd; /* (M, J) */
  double *centres, *counts;    /* (M, S, places, tau, J), (M, S, places) */
} frozen;

/* Signals of each iteration of a trial. */
typedef struct {
  outcome *outcome;        /* (N,) */
  double *eta_dot, *R, *Q; /* (N, J), (N, S) of the stay entries, (N, S, 2) */
  int64_t *policy;         /* (N, S) */
} curves;

/* gate.c */
double slowness(double derivative, double variance);
void instantaneous_slowness(int64_t n, int64_t J, const double *y, double *eta);
int recognise(const agent *a, const frozen *f, const frames *shown, const frames *x,
              double *y_frozen, double *eta_inst, double *roc_error);

/* agent.c */
void action_values(const agent *a, double *Q);
int think(const agent *a, const double *xi, const double *y, int64_t t, const double *uniforms);
int iterate(const agent *a, const frozen *f, const incsfa *feature, const frames *shown,
            const frames *x, int64_t t, const double *uniforms, double *y, double *y_frozen,
            double *eta_inst, double *roc_error);
int64_t iterations(const agent *a, const frozen *f, const incsfa *feature, const frames *shown,
                   const frames *x, const double *uniforms, int64_t n, double swap_below,
                   const curves *kept);
void own_work(const agent *a, const frozen *f, int64_t blocks, int64_t phases, const double *y,
              const double *y_frozen, double *told);

/* frames.c: a message of a chunk, and offset and size of its payload */
typedef struct {
  uint64_t log_time, publish_time; /* ns */
  int64_t at, size;
  uint32_t sequence;
  uint16_t channel, unused;
} message;
/* Result of a walk over records: their numbers, its end, and the range of log times. */
typedef struct {
  int64_t messages, others, end;
  uint64_t earliest, latest; /* 2^64 - 1 and 0 without messages */
} walked;
/* Walk over the records of a chunk up to the first invalid one. Written: messages
 * (found->messages,), and others (found->others, 2) first byte and end of other records, each
 * unless NULL. */
int walk_records(const uint8_t *data, int64_t size, message *messages, int64_t *others,
                 walked *found);

/* Layout of payloads with at least `least` bytes: the distances from the payload's end of R values
 * of a width, and of M bytes that are equal in all messages. */
typedef struct {
  int64_t least, values, width, marks;
  const int64_t *distances, *places; /* (R,), (M,) */
  const uint8_t *bytes;              /* (M,) */
} layout;
/* Check the layout of messages [start, stop) of a channel among the messages (n,) of a chunk, and
 * copy their values to out (stop - start, R, width) unless that is NULL. Returns the number of
 * messages of the channel, or OUT_OF_ORDER. */
int64_t gather(const uint8_t *data, int64_t size, const message *messages, int64_t n,
               uint16_t channel, int64_t start, int64_t stop, const layout *l, uint8_t *out);

/* eigen.c: matrix and vectors (n, n), values (n,), scratch (3 n,) */
void eigen(int64_t n, double *matrix, double *values, double *vectors, double *spare);

/* recursive.c: I inputs, L directions, K whitened components, W of the outputs, J outputs */
enum { PIECE = 64 }; /* frames in one update of the basis; longer blocks are cut into such pieces */
typedef struct {
  int64_t inputs, size, components, wide, outputs; /* I, L, K, W, J */
  int64_t principal;   /* the last outputs, which are principal components; the others are slow */
  int64_t window;      /* exponential window (frames) */
  double *mean;        /* (I,) */
  double *basis;       /* (L, I) orthonormal directions, in order of falling variance */
  double *variance;    /* (L,) variance of the frames along each direction */
  double *differences; /* (L, L) mean products of the differences of frames along the directions */
  double *weights;     /* (J, L) outputs as weights of the directions */
  double *spectrum;    /* (K,) slowness of the slow features of K components, the slowest first */
  double *last;        /* (I,) the last frame */
  int64_t *counts;     /* (3,) directions in use, frames, differences */
} recursive;
int recursive_update(const recursive *sfa, const frames *x, int gap, double *change);
