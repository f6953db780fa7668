/* The yardstick of mpmcli bench: an MLS-MPM step of a fluid in C, f32, with vectors of four numbers.

   Quadratic B-splines, APIC, walls that slip (nodes on and behind them have no normal velocity), and a fluid of linear pressure,
   tau = K (J - 1), where J is multiplied by det(I + dt C). The first velocity is that of the first step's start
   (symplectic Euler). Compile with -DD=2 or -DD=3, the flags of `peers.py`.

   A node is one vector: momentum in the first D numbers, mass in the last. Particles are sorted by cell whenever one may
   have moved by a cell. Tiles of TILE cells across all axes but the last one are scattered in colours: those of one
   colour reach no common node, so threads need no atomics, and sums do not depend on their number. */

#include <omp.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

typedef float v4 __attribute__((vector_size(16)));
typedef int i4 __attribute__((vector_size(16)));

enum { PAD = 3, TILE = 4, MASS = 3, COLOURS = 1 << (D - 1), PER_TILE = D == 3 ? TILE * TILE : TILE };
/* Cells that a particle may move between two sorts: a tile reaches as many and two nodes beyond its cells. */
static const float DRIFT = 1.0f;
/* Places of the phases in `seconds`. */
enum { SORT, P2G, GRID, G2P, PHASES };

/* Position in cells, with J as last number; velocity, m/s; derivatives of the velocity along each axis, 1/s. */
typedef struct {
    v4 x, v, C[D];
} particle;

typedef struct {
    int count, cells, threads, tension;
    float h, dt, gravity, mass, volume, bulk;
    particle *p, *other;
    int *id, *other_id, *key, *start;
    long keys;
    v4 *grid;
    long stride[3];
    /* Of the last sort: first cell and number of cells with particles, and tiles, along each axis. */
    int first[3], size[3], tiles[3];
    float drift;
    double seconds[PHASES];
} yardstick;

/* Processor time of a lone thread, which excludes that of other processes; otherwise wall time, s. */
static double now(const yardstick *s) {
    struct timespec t;
    clock_gettime(s->threads == 1 ? CLOCK_THREAD_CPUTIME_ID : CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static i4 first_node(v4 x) { return __builtin_convertvector(x - 0.5f, i4); }

static v4 chosen(i4 where, v4 x, v4 other) { return (v4)((where & (i4)x) | (~where & (i4)other)); }

static v4 larger(v4 x, v4 y) { return chosen(x > y, x, y); }

static v4 smaller(v4 x, v4 y) { return chosen(x < y, x, y); }

static v4 broadcast(v4 x, int lane) { return __builtin_shuffle(x, (i4){lane, lane, lane, lane}); }

/* Weights of the three nodes of a stencil along each axis, d being the distance to the first one, in cells. */
static void weights(v4 d, v4 w[3]) {
    w[0] = 0.5f * (1.5f - d) * (1.5f - d);
    w[1] = 0.75f - (d - 1.0f) * (d - 1.0f);
    w[2] = 0.5f * (d - 0.5f) * (d - 0.5f);
}

static void free_arrays(yardstick *s) {
    void *all[] = {s->p, s->other, s->id, s->other_id, s->key, s->start, s->grid};
    for (int k = 0; k < 7; k++) free(all[k]);
}

void yardstick_free(yardstick *s) {
    free_arrays(s);
    free(s);
}

/* Returns NULL where memory does not suffice. x and v: (count, D), in a box of edge cells * h. */
yardstick *yardstick_new(int count, int cells, int threads, int tension, float h, float dt, float gravity, float mass,
                         float volume, float bulk, const float *x, const float *v) {
    yardstick *s = calloc(1, sizeof *s);
    if (!s) return NULL;
    *s = (yardstick){.count = count, .cells = cells, .threads = threads, .tension = tension, .h = h, .dt = dt};
    s->gravity = gravity, s->mass = mass, s->volume = volume, s->bulk = bulk;
    long width = cells + 1 + 2 * PAD, nodes = 1;
    for (int a = D - 1; a >= 0; a--) s->stride[a] = nodes, nodes *= width;
    long tiles = (width + TILE - 1) / TILE;
    s->keys = (D == 3 ? tiles * tiles : tiles) * width * PER_TILE;
    s->p = aligned_alloc(64, (count * sizeof *s->p + 63) / 64 * 64);
    s->other = aligned_alloc(64, (count * sizeof *s->p + 63) / 64 * 64);
    s->grid = aligned_alloc(64, (nodes * sizeof *s->grid + 63) / 64 * 64);
    s->id = malloc(count * sizeof *s->id);
    s->other_id = malloc(count * sizeof *s->id);
    s->key = malloc(count * sizeof *s->key);
    s->start = malloc((s->keys + 1) * sizeof *s->start);
    if (!s->p || !s->other || !s->grid || !s->id || !s->other_id || !s->key || !s->start) {
        yardstick_free(s);
        return NULL;
    }
    for (int q = 0; q < count; q++) {
        particle p = {0};
        for (int a = 0; a < D; a++) p.x[a] = x[q * D + a] / h + PAD, p.v[a] = v[q * D + a];
        p.x[MASS] = 1.0f;
        s->p[q] = p, s->id[q] = q;
    }
    s->drift = 2 * DRIFT;
    return s;
}

/* Positions and velocities in the initial order, (count, D). */
void yardstick_read(const yardstick *s, float *x, float *v) {
    for (int q = 0; q < s->count; q++)
        for (int a = 0; a < D; a++) {
            x[s->id[q] * (long)D + a] = (s->p[q].x[a] - PAD) * s->h;
            v[s->id[q] * (long)D + a] = s->p[q].v[a];
        }
}

/* Seconds so far in sorts, P2G with clearing, the update of nodes, and G2P. */
void yardstick_seconds(const yardstick *s, double *seconds) { memcpy(seconds, s->seconds, sizeof s->seconds); }

/* Orders particles by tile, in a tile by the last axis, and there by cell; finds the box of their cells. */
static void sort(yardstick *s) {
    const v4 first = (v4){0} + (PAD - 0.5f), last = first + (s->cells + 1.0f);
    v4 least = last, most = first;
    for (int q = 0; q < s->count; q++) {
        /* Nothing leaves the grid, whatever happens. */
        v4 x = smaller(larger(s->p[q].x, first), last);
        least = smaller(least, x), most = larger(most, x);
        x[MASS] = s->p[q].x[MASS];
        s->p[q].x = x;
    }
    i4 low = first_node(least), high = first_node(most);
    for (int a = 0; a < D; a++) {
        s->first[a] = low[a], s->size[a] = high[a] - low[a] + 1;
        s->tiles[a] = a == D - 1 ? 1 : (s->size[a] + TILE - 1) / TILE;
    }
    long tiles = s->tiles[0] * (D == 3 ? s->tiles[1] : 1), layers = s->size[D - 1], keys = tiles * layers * PER_TILE;
    memset(s->start, 0, (keys + 1) * sizeof *s->start);
    for (int q = 0; q < s->count; q++) {
        i4 b = first_node(s->p[q].x) - low;
        long tile = b[0] / TILE, inside = b[0] % TILE;
        if (D == 3) tile = tile * s->tiles[1] + b[1] / TILE, inside = inside * TILE + b[1] % TILE;
        s->key[q] = (tile * layers + b[D - 1]) * PER_TILE + inside;
        s->start[s->key[q] + 1]++;
    }
    for (long k = 0; k < keys; k++) s->start[k + 1] += s->start[k];
    for (int q = 0; q < s->count; q++) {
        int place = s->start[s->key[q]]++;
        s->other[place] = s->p[q], s->other_id[place] = s->id[q];
    }
    /* Each start has become the next one: those of tiles move back by one place. */
    for (long t = 1; t <= tiles; t++) s->start[t] = s->start[t * layers * PER_TILE - 1];
    s->start[0] = 0;
    particle *p = s->p;
    int *id = s->id;
    s->p = s->other, s->other = p, s->id = s->other_id, s->other_id = id;
    s->drift = 0;
}

/* Adds the vector q + j A + k B, times weights, to the nodes (j, k) of a plane. */
static inline void scatter_plane(v4 *g, long stride, v4 q, v4 A, v4 B, const float *wa, const float *wb) {
#pragma GCC unroll 3
    for (int j = 0; j < 3; j++, g += stride) {
        v4 row = wa[j] * (q + (float)j * A), along = wa[j] * B;
        g[0] += wb[0] * row;
        row += along;
        g[1] += wb[1] * row;
        row += along;
        g[2] += wb[2] * row;
    }
}

static void scatter(yardstick *s, int begin, int end) {
    const float h = s->h, stress = -4 * s->dt / h * s->volume * s->bulk, affine = s->mass * h;
    for (int q = begin; q < end; q++) {
        const particle *p = &s->p[q];
        i4 base = first_node(p->x);
        v4 d = p->x - __builtin_convertvector(base, v4), w[3], A[D];
        weights(d, w);
        float J = p->x[MASS], tau = stress * (s->tension || J < 1 ? J - 1 : 0);
        v4 m = p->v * s->mass;
        m[MASS] = s->mass;
        long node = 0;
        float wa[D][3];
#pragma GCC unroll 3
        for (int a = 0; a < D; a++) {
            A[a] = affine * p->C[a];
            A[a][a] += tau;
            m -= d[a] * A[a];
            node += base[a] * s->stride[a];
            for (int k = 0; k < 3; k++) wa[a][k] = w[k][a];
        }
        v4 *g = s->grid + node;
#if D == 3
#pragma GCC unroll 3
        for (int i = 0; i < 3; i++) {
            v4 at = m + (float)i * A[0];
            scatter_plane(g + i * s->stride[0], s->stride[1], wa[0][i] * at, wa[0][i] * A[1], wa[0][i] * A[2], wa[1], wa[2]);
        }
#else
        scatter_plane(g, s->stride[0], m, A[0], A[1], wa[0], wa[1]);
#endif
    }
}

/* Sums over the nodes (j, k) of a plane: the velocity, j times it, and k times it, each times weights. */
static inline void gather_plane(const v4 *g, long stride, const float *wa, const float *wb, v4 sum[3]) {
    sum[0] = sum[1] = sum[2] = (v4){0};
#pragma GCC unroll 3
    for (int j = 0; j < 3; j++, g += stride) {
        v4 middle = wb[1] * g[1], last = wb[2] * g[2], row = wa[j] * (wb[0] * g[0] + middle + last);
        sum[0] += row;
        sum[1] += (float)j * row;
        sum[2] += wa[j] * (middle + 2.0f * last);
    }
}

static void gather(yardstick *s, int begin, int end) {
    const float scale = 4 / s->h, dt = s->dt, cells = s->dt / s->h;
    for (int q = begin; q < end; q++) {
        particle *p = &s->p[q];
        i4 base = first_node(p->x);
        v4 d = p->x - __builtin_convertvector(base, v4), w[3], v = {0}, moment[D];
        weights(d, w);
        long node = 0;
        float wa[D][3];
#pragma GCC unroll 3
        for (int a = 0; a < D; a++) {
            node += base[a] * s->stride[a];
            for (int k = 0; k < 3; k++) wa[a][k] = w[k][a];
        }
        const v4 *g = s->grid + node;
        v4 sum[3];
#if D == 3
        moment[0] = moment[1] = moment[2] = (v4){0};
#pragma GCC unroll 3
        for (int i = 0; i < 3; i++) {
            gather_plane(g + i * s->stride[0], s->stride[1], wa[1], wa[2], sum);
            v4 row = wa[0][i] * sum[0];
            v += row;
            moment[0] += (float)i * row;
            moment[1] += wa[0][i] * sum[1];
            moment[2] += wa[0][i] * sum[2];
        }
#else
        gather_plane(g, s->stride[0], wa[0], wa[1], sum);
        v = sum[0], moment[0] = sum[1], moment[1] = sum[2];
#endif
        v4 F[D];
#pragma GCC unroll 3
        for (int a = 0; a < D; a++) {
            p->C[a] = scale * (moment[a] - d[a] * v);
            F[a] = dt * p->C[a];
            F[a][a] += 1;
        }
#if D == 3
        float change = F[0][0] * (F[1][1] * F[2][2] - F[1][2] * F[2][1]) +
                       F[0][1] * (F[1][2] * F[2][0] - F[1][0] * F[2][2]) +
                       F[0][2] * (F[1][0] * F[2][1] - F[1][1] * F[2][0]);
#else
        float change = F[0][0] * F[1][1] - F[0][1] * F[1][0];
#endif
        v4 x = p->x + cells * v;
        x[MASS] = p->x[MASS] * change;
        p->x = x, p->v = v;
    }
}

/* A row of nodes along the last axis of the box that particles reach since the last sort; n counts rows. */
static v4 *row_of(const yardstick *s, int n, int node[D], int *length) {
    const int beyond = (int)DRIFT;
    long place = 0;
    for (int a = D - 2; a >= 0; a--) {
        int size = s->size[a] + 2 + 2 * beyond;
        node[a] = s->first[a] - beyond + n % size, n /= size;
        place += node[a] * s->stride[a];
    }
    node[D - 1] = s->first[D - 1] - beyond, *length = s->size[D - 1] + 2 + 2 * beyond;
    return s->grid + place + node[D - 1];
}

static int row_count(const yardstick *s) {
    int rows = 1;
    for (int a = 0; a < D - 1; a++) rows *= s->size[a] + 2 + 2 * (int)DRIFT;
    return rows;
}

static void clear_row(yardstick *s, int n) {
    int node[D], length;
    v4 *g = row_of(s, n, node, &length);
    memset(g, 0, length * sizeof *g);
}

/* Returns the largest speed along an axis, m/s, which no particle exceeds. */
static float update_row(yardstick *s, int n) {
    int node[D], length, last = PAD + s->cells;
    v4 *g = row_of(s, n, node, &length), open = {1, 1, 1, 0}, fall = {0}, top = {0};
    fall[1] = -s->dt * s->gravity;
    for (int a = 0; a < D - 1; a++) open[a] = node[a] > PAD && node[a] < last;
    for (int k = 0; k < length; k++) {
        v4 m = broadcast(g[k], MASS), v = open * (g[k] / m + fall);
        if (node[D - 1] + k <= PAD || node[D - 1] + k >= last) v[D - 1] = 0;
        g[k] = chosen(m > 0, v, (v4){0});
        top = larger(top, larger(g[k], -g[k]));
    }
    float speed = 0;
    for (int a = 0; a < D; a++) speed = top[a] > speed ? top[a] : speed;
    return speed;
}

/* Takes steps. */
void yardstick_advance(yardstick *s, int steps) {
    float speed = 0;
#pragma omp parallel num_threads(s->threads)
    for (int step = 0; step < steps; step++) {
        double times[PHASES + 1];
        times[SORT] = now(s);
#pragma omp single
        if (s->drift > DRIFT) sort(s);
        times[P2G] = now(s);
#pragma omp for schedule(static)
        for (int n = 0; n < row_count(s); n++) clear_row(s, n);
        for (int colour = 0; colour < COLOURS; colour++) {
            int across = D == 3 ? s->tiles[1] : 1, odd = colour % 2, begin = D == 3 ? colour / 2 : odd;
            int rows = (s->tiles[0] - begin + 1) / 2, columns = D == 3 ? (across - odd + 1) / 2 : 1;
#pragma omp for schedule(dynamic, 1)
            for (int n = 0; n < rows * columns; n++) {
                int tile = (begin + 2 * (n / columns)) * across + (D == 3 ? odd + 2 * (n % columns) : 0);
                scatter(s, s->start[tile], s->start[tile + 1]);
            }
        }
        times[GRID] = now(s);
#pragma omp for schedule(static) reduction(max : speed)
        for (int n = 0; n < row_count(s); n++) {
            float own = update_row(s, n);
            speed = own > speed ? own : speed;
        }
        times[G2P] = now(s);
        int chunks = 16 * s->threads;
#pragma omp for schedule(static)
        for (int c = 0; c < chunks; c++) gather(s, (long)s->count * c / chunks, (long)s->count * (c + 1) / chunks);
        times[PHASES] = now(s);
#pragma omp single
        {
            s->drift += speed * s->dt / s->h;
            speed = 0;
            for (int k = 0; k < PHASES; k++) s->seconds[k] += times[k + 1] - times[k];
        }
    }
}
