// The floor of the speed benchmark: local level INS/GNSS filter of 9 or 15 states as near to the machine as plain C++
// comes. Same equations as the package (ENU strapdown with coning and sculling, full error dynamics of second order,
// covariance at every sample, position and velocity by scalar Joseph updates, closed loop; biases are random walks),
// written for one run (L = double) or eight side by side (L = a vector of eight).
//
// The covariance moves by the midpoint rule of P' = F P + P F' + G, which is Phi P Phi' + Q to the order that is kept
// and costs two products with the sparse F.
#include <cmath>
#include <cstring>
#include <utility>

typedef double v8 __attribute__((vector_size(64)));
template <class L> constexpr int lanes = sizeof(L) / sizeof(double);

template <class L, double (*f)(double)>
static inline L map(L x) {
  double a[lanes<L>];
  std::memcpy(a, &x, sizeof(L));
  for (double& e : a) e = f(e);
  std::memcpy(&x, a, sizeof(L));
  return x;
}

template <class L> static inline L root(L x) { return map<L, std::sqrt>(x); }
template <class L> static inline L sine(L x) { return map<L, std::sin>(x); }
template <class L> static inline L cosine(L x) { return map<L, std::cos>(x); }
template <class L> static inline L load(const double* p) { L x; std::memcpy(&x, p, sizeof(L)); return x; }

constexpr double A = 6378137.0, FLAT = 1 / 298.257223563, E2 = FLAT * (2 - FLAT), RATE = 7.292115e-5;
constexpr double GE = 9.7803253359, GP = 9.8321849378, SOMIGLIANA = (1 - FLAT) * GP / GE - 1;

template <class L> struct Vec {
  L x, y, z;
  Vec operator+(Vec b) const { return {x + b.x, y + b.y, z + b.z}; }
  Vec operator-(Vec b) const { return {x - b.x, y - b.y, z - b.z}; }
  Vec operator*(L s) const { return {x * s, y * s, z * s}; }
};
template <class L> static inline Vec<L> cross(Vec<L> a, Vec<L> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

template <class L> struct Quat { L w, x, y, z; };
template <class L> static inline Quat<L> operator*(Quat<L> a, Quat<L> b) {
  return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
          a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}
// rotations of up to some tenths of a radian: the series is exact to rounding there
template <class L> static inline Quat<L> turn(Vec<L> p) {
  L n = p.x * p.x + p.y * p.y + p.z * p.z;
  L c = 1 - n / 8 * (1 - n / 48 * (1 - n / 120 * (1 - n / 224)));
  L s = 0.5 * (1 - n / 24 * (1 - n / 80 * (1 - n / 168 * (1 - n / 288))));
  return {c, s * p.x, s * p.y, s * p.z};
}
template <class L> static inline Quat<L> unit(Quat<L> q) {
  L s = 1 / root(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
  return {q.w * s, q.x * s, q.y * s, q.z * s};
}

template <class L> struct Mat { L a[3][3]; };
template <class L> static inline Mat<L> matrix(Quat<L> q) {
  L w = q.w, x = q.x, y = q.y, z = q.z;
  return {{{w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)},
           {2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)},
           {2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z}}};
}
template <class L> static inline Vec<L> operator*(const Mat<L>& m, Vec<L> v) {
  return {m.a[0][0] * v.x + m.a[0][1] * v.y + m.a[0][2] * v.z, m.a[1][0] * v.x + m.a[1][1] * v.y + m.a[1][2] * v.z,
          m.a[2][0] * v.x + m.a[2][1] * v.y + m.a[2][2] * v.z};
}

// where F is not zero: its first nine rows; biases are random walks
constexpr bool NZ[9][15] = {
    {1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0}, {0, 1, 1, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0},
    {0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0}, {0, 1, 1, 1, 1, 1, 0, 1, 1, 0, 0, 0, 1, 1, 1},
    {0, 1, 1, 1, 1, 1, 1, 0, 1, 0, 0, 0, 1, 1, 1}, {0, 1, 1, 1, 1, 0, 1, 1, 0, 0, 0, 0, 1, 1, 1},
    {0, 0, 1, 0, 1, 0, 0, 1, 1, 1, 1, 1, 0, 0, 0}, {0, 1, 1, 1, 0, 0, 1, 0, 1, 1, 1, 1, 0, 0, 0},
    {0, 1, 1, 1, 0, 0, 1, 1, 0, 1, 1, 1, 0, 0, 0}};

// Row I of F S; the loop over k folds at compile time. Of the symmetric S the eight lanes keep the upper half only, while
// one run keeps all of it and works along its rows.
template <class L, int N, int I, std::size_t... K>
static inline void row(const L (&F)[9][15], const L (&S)[N][N], L (&X)[9][N], std::index_sequence<K...>) {
  L sum[N] = {};
  auto term = [&](auto k) {
    if constexpr (NZ[I][k.value]) {
      constexpr int m = k.value;
#pragma GCC unroll 16
      for (int j = 0; j < N; j++) sum[j] += F[I][m] * (lanes<L> > 1 && j < m ? S[j][m] : S[m][j]);
    }
  };
  (term(std::integral_constant<int, K>{}), ...);
  for (int j = 0; j < N; j++) X[I][j] = sum[j];
}
template <class L, int N, std::size_t... I>
static inline void product(const L (&F)[9][15], const L (&S)[N][N], L (&X)[9][N], std::index_sequence<I...>) {
  (row<L, N, I>(F, S, X, std::make_index_sequence<N>{}), ...);
}

// S = P + T (X + X' + G), where X has nine rows
template <class L, int N>
static inline void grow(const L (&P)[N][N], const L (&X)[9][N], const L (&G)[6][3], const double* psd, double T,
                        L (&S)[N][N]) {
#pragma GCC unroll 16
  for (int i = 0; i < 9; i++) {
#pragma GCC unroll 16
    for (int j = i; j < N; j++) {
      L rate = X[i][j];
      if (j < 9) rate += X[j][i];
      if (i / 3 == j / 3 && i >= 3) rate += G[i - 3][j % 3];
      S[i][j] = P[i][j] + T * rate;
      if (lanes<L> == 1) S[j][i] = S[i][j];
    }
  }
  for (int i = 9; i < N; i++)
    for (int j = 9; j < N; j++) S[i][j] = P[i][j] + (i == j ? T * psd[i - 3] : 0.0);
}

// n states, samples of an epoch; psd: accel, gyro, gyro bias, accel bias, three each. Arrays are (..., lanes):
// imu (epochs, samples, 7) dt gyro accel, fix (epochs, 12) value and variance, start (10 + N) lla, vel, q, variances;
// out (epochs, 10) lla, vel, q.
template <class L, int N>
static void filter(int epochs, int samples, const double* imu, const double* fix, const double* start,
                   const double* psd, double* out) {
  constexpr int B = lanes<L>;
  auto triple = [](const double* p) { return Vec<L>{load<L>(p), load<L>(p + B), load<L>(p + 2 * B)}; };
  alignas(64) L P[N][N] = {}, S[N][N] = {}, X[9][N] = {}, F[9][15] = {}, G[6][3];
  L lat = load<L>(start), lon = load<L>(start + B), h = load<L>(start + 2 * B);
  Vec<L> v = triple(start + 3 * B), zero = {lat * 0, lat * 0, lat * 0}, bg = zero, ba = zero, w0 = zero, f0 = zero;
  Quat<L> q = {load<L>(start + 6 * B), load<L>(start + 7 * B), load<L>(start + 8 * B), load<L>(start + 9 * B)};
  for (int i = 0; i < N; i++) P[i][i] = load<L>(start + (10 + i) * B);
  F[0][3] = F[1][4] = F[2][5] = zero.x + 1;
  L rn, re, s, c;
  for (int e = 0; e < epochs; e++) {
    Mat<L> before = matrix(q);
    for (int sample = 0; sample < samples; sample++, imu += 7 * B) {
      double T = imu[0];
      Vec<L> w = triple(imu + B) - bg, f = triple(imu + 4 * B) - ba, wf = cross(w, f);
      L T1 = zero.x + T, T2 = T1 * T;
      Vec<L> theta = w * T1 + cross(w0, w) * (T2 / 12);
      Vec<L> push = f * T1 + wf * (T2 / 2) + cross(w, wf) * (T2 * T / 6) + (cross(w0, f) + cross(f0, w)) * (T2 / 12);
      w0 = w, f0 = f;
      L half = lat + 0.5 * T / A * v.y, up = h + 0.5 * T * v.z;  // half-way
      s = sine(half), c = cosine(half);
      L w2 = 1 - E2 * s * s, inverse = 1 / root(w2), prime = A * inverse;
      re = prime + up, rn = prime * (1 - E2) / w2 + up;
      L g = GE * (1 + SOMIGLIANA * s * s) * inverse * (1 - 2 / A * up), ire = 1 / re, irn = 1 / rn, tan = s / c;
      Vec<L> ie = {zero.x, RATE * c, RATE * s}, down = {zero.x, zero.x, -g};
      auto transport = [&](Vec<L> u) { return Vec<L>{-u.y * irn, u.x * ire, u.x * ire * tan}; };
      Vec<L> en = transport(v), level = (ie + en) * T1;
      push = before * push;
      Vec<L> lag = cross(level, push);
      push = push - lag * (zero.x + 0.5) + cross(level, lag) * (zero.x + 1.0 / 12);
      Vec<L> mid = v + (push + (down - cross(ie + ie + en, v)) * T1) * (zero.x + 0.5);
      en = transport(mid);
      Vec<L> dv = push + (down - cross(ie + ie + en, mid)) * T1, mean = v + dv * (zero.x + 0.5);
      lat += mean.y * T * irn, lon += mean.x * T * ire / c, h += mean.z * T;
      v = v + dv;
      q = unit(turn((ie + en) * (-T1)) * (q * turn(theta)));
      Mat<L> after = matrix(q), C;
      for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) C.a[i][j] = 0.5 * (before.a[i][j] + after.a[i][j]);
      before = after;
      f = C * f;
      // F, with latitude and height half-way: 1e-8 of it
      en = transport(v), w = ie + en;
      Vec<L> u = w + ie;
      L e1 = v.x * ire, n1 = v.y * irn, u1 = v.z * irn, u2 = v.z * ire;
      L k1 = -RATE * s * irn, k2 = RATE * c * irn, k3 = e1 * irn * (1 + tan * tan);  // rates per metre north
      L up0 = n1 * irn, up1 = -e1 * ire, up2 = -e1 * ire * tan;                      // and up
      F[0][0] = u2 - n1 * tan, F[0][1] = v.x * irn * tan, F[0][2] = -e1, F[1][1] = u1, F[1][2] = -n1;
      L a1 = 2 * k1, a2 = 2 * k2 + k3;
      F[3][1] = v.y * a2 - v.z * a1, F[4][1] = -v.x * a2, F[5][1] = v.x * a1;
      F[3][2] = v.y * up2 - v.z * up1, F[4][2] = v.z * up0 - v.x * up2, F[5][2] = v.x * up1 - v.y * up0;
      F[5][2] += 2 * g / A;
      F[3][3] = v.y * ire * tan - u2, F[3][4] = u.z, F[3][5] = -u.y;
      F[4][3] = -u.z - e1 * tan, F[4][4] = -u1, F[4][5] = u.x;
      F[5][3] = u.y + e1, F[5][4] = n1 - u.x;
      F[3][7] = f.z, F[3][8] = -f.y, F[4][6] = -f.z, F[4][8] = f.x, F[5][6] = f.y, F[5][7] = -f.x;
      F[6][4] = irn, F[7][3] = -ire, F[8][3] = -tan * ire;
      F[7][1] = -k1, F[8][1] = -k2 - k3, F[6][2] = -up0, F[7][2] = -up1, F[8][2] = -up2;
      F[6][7] = w.z, F[6][8] = -w.y, F[7][6] = -w.z, F[7][8] = w.x, F[8][6] = w.y, F[8][7] = -w.x;
      for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
          F[3 + i][12 + j] = F[6 + i][9 + j] = -C.a[i][j];
          G[i][j] = G[3 + i][j] = zero.x;
          for (int k = 0; k < 3; k++) {
            L square = C.a[i][k] * C.a[j][k];
            G[i][j] += psd[k] * square, G[3 + i][j] += psd[3 + k] * square;
          }
        }
      product(F, P, X, std::make_index_sequence<9>{});
      grow<L, N>(P, X, G, psd, 0.5 * T, S);
      product(F, S, X, std::make_index_sequence<9>{});
      grow<L, N>(P, X, G, psd, T, P);
    }
    L d[6] = {(lon - load<L>(fix + B)) * re * c, (lat - load<L>(fix)) * rn, h - load<L>(fix + 2 * B),
              v.x - load<L>(fix + 3 * B), v.y - load<L>(fix + 4 * B), v.z - load<L>(fix + 5 * B)};
    L x[15] = {};
    if (lanes<L> > 1)
      for (int i = 0; i < N; i++)
        for (int j = 0; j < i; j++) P[i][j] = P[j][i];
    for (int m = 0; m < 6; m++) {
      L r = load<L>(fix + (6 + m) * B), K[N], PK[N], own = d[m] - x[m], gain = 1 / (P[m][m] + r);
      for (int i = 0; i < N; i++) K[i] = P[i][m] * gain, PK[i] = P[i][m];
      for (int i = 0; i < N; i++) x[i] += K[i] * own;
      for (int i = 0; i < N; i++)  // (I - K H) P (I - K H)' + K r K' with H a unit row
        for (int j = 0; j < N; j++)
          P[i][j] += K[i] * K[j] * (PK[m] + r) - K[i] * PK[j] - PK[i] * K[j];
    }
    fix += 12 * B;
    lat -= x[1] / rn, lon -= x[0] / (re * c), h -= x[2], v = v - Vec<L>{x[3], x[4], x[5]};
    q = unit(turn(Vec<L>{-x[6], -x[7], -x[8]}) * q);
    bg = bg - Vec<L>{x[9], x[10], x[11]}, ba = ba - Vec<L>{x[12], x[13], x[14]};
    L row[10] = {lat, lon, h, v.x, v.y, v.z, q.w, q.x, q.y, q.z};
    std::memcpy(out, row, sizeof(row));
    out += 10 * B;
  }
}

#if LANES == 1
typedef double Lane;
#else
typedef v8 Lane;
#endif

template <int N>
static void batch(int groups, int epochs, int samples, const double* imu, const double* fix, const double* start,
                  const double* psd, double* out) {
  constexpr long B = lanes<Lane>;
  for (long i = 0; i < groups; i++)
    filter<Lane, N>(epochs, samples, imu + i * epochs * samples * 7 * B, fix + i * epochs * 12 * B,
                    start + i * (10 + N) * B, psd, out + i * epochs * 10 * B);
}

#define FORM(N)                                                                                            \
  extern "C" void floor_##N(int groups, int epochs, int samples, const double* imu, const double* fix,     \
                            const double* start, const double* psd, double* out) {                         \
    batch<N>(groups, epochs, samples, imu, fix, start, psd, out);                                          \
  }
FORM(9)
FORM(15)
