/*
 * The actuator's equations once more, by hand: what the compiled Python is measured against.
 *
 * model_parameters.h is written by model_speed.py: `struct parameters` and `struct state` with the
 * fields, in order, of the records that the Python code uses.
 */
#include <math.h>
#include "model_parameters.h"

enum { OFF, LINEAR, FULL };
enum { LOCKED, SPRING, FREE, PRESCRIBED };

#define ELASTIC_SHARE 0.7
#define FAR 7.0
#define STRAIGHT 2e-5
#define MOST_ROUNDS 60

struct second_order { double keep, pull, half_step; };
struct delay { long whole; double part; };
struct constants {
    double half_decay, coil_decay, keep, old, new;
    struct second_order pipe, sensor, card;
    struct delay valve_delay, sensor_delay;
    double h;
};
struct rub { double seal, seal_slope, force, force_slope; };

static inline double clamp(double x, double low, double high)
{
    return fmin(fmax(x, low), high);
}

static inline double fast_tanh(double x)
{
    return 1.0 - 2.0 / (exp(2.0 * x) + 1.0);
}

static struct second_order second_order(double frequency, double damping_ratio, double h)
{
    double w = 2.0 * M_PI * frequency, half = 0.5 * h;
    double damp = 2.0 * damping_ratio * w * half, stiff = w * w * half * half;
    double whole = 1.0 + damp + stiff;
    return (struct second_order){(1.0 - damp - stiff) / whole, 2.0 * w * w * half / whole, half};
}

static struct delay delay_steps(double delay, double h)
{
    double steps = delay / h;
    return (struct delay){(long)steps, steps - (long)steps};
}

static struct constants constants(const struct parameters *p, double h)
{
    struct constants c = {.h = h};
    c.half_decay = exp(-M_PI * p->valve_hysteresis_rate_filter * h);
    c.coil_decay = exp(-2.0 * M_PI * p->valve_flexure_coil_frequency * h);
    c.pipe = second_order(p->valve_flexure_natural_frequency, p->valve_flexure_damping_ratio, h);
    c.sensor = second_order(p->force_sensor_natural_frequency, p->force_sensor_damping_ratio, h);
    c.card = second_order(p->force_sensor_card_frequency, sqrt(0.5), h);
    c.valve_delay = delay_steps(p->valve_flexure_delay, h);
    c.sensor_delay = delay_steps(p->force_sensor_delay, h);
    if (p->fluid_dynamics_model == FULL) {
        double x = 2.0 * M_PI * p->fluid_dynamics_frequency * h, mean = -expm1(-x) / x;
        c.keep = exp(-x);
        c.old = mean - c.keep;
        c.new = 1.0 - mean;
    } else {
        c.new = p->fluid_dynamics_model == LINEAR ? p->fluid_dynamics_linear_gain : 1.0;
    }
    return c;
}

static inline void lag(double *output, double *rate, double input, struct second_order c)
{
    double after = c.keep * *rate + c.pull * (input - *output);
    *output += c.half_step * (*rate + after);
    *rate = after;
}

static inline double delayed(double *ring, long index, double value, struct delay d)
{
    ring[index] = value;
    double newer = ring[(index - d.whole) & (RING - 1)];
    double older = ring[(index - d.whole - 1) & (RING - 1)];
    return newer + d.part * (older - newer);
}

static inline double magnetise(struct state *s, double command, double decay,
                               const struct parameters *p)
{
    s->command_filtered = command + (s->command_filtered - command) * decay;
    if (p->valve_hysteresis_model != FULL) {
        double gain = p->valve_hysteresis_model == LINEAR ? p->valve_hysteresis_linear_gain : 1.0;
        return s->drive = s->flux = gain * command;
    }
    double speed = fabs(2.0 * M_PI * p->valve_hysteresis_rate_filter
                        * (command - s->command_filtered));
    double radius = p->valve_hysteresis_radius;
    if (speed != 0.0)
        radius += p->valve_hysteresis_lag_time * speed
            * pow(speed / p->valve_hysteresis_reference_rate, p->valve_hysteresis_rate_exponent);
    s->flux = clamp(s->flux, command - radius, command + radius);
    double relative = s->flux / p->valve_hysteresis_saturation, square = relative * relative;
    return s->drive = s->flux / sqrt(sqrt(1.0 + square * square));
}

static inline double valve_position(double deflection, const struct parameters *p)
{
    return p->valve_characteristic_gain * deflection / p->valve_characteristic_maximum_force
        * p->valve_characteristic_full_opening;
}

static inline double static_force(double position, const struct parameters *p)
{
    double relative = position / p->valve_characteristic_full_opening;
    if (p->valve_characteristic_model == FULL)
        relative = clamp(relative, -1.0, 1.0);
    else if (p->valve_characteristic_model == LINEAR)
        relative *= p->valve_characteristic_linear_gain;
    return relative * p->valve_characteristic_maximum_force;
}

struct curve { double magnitude, extending, retracting, width, at_rest; };

static inline struct curve damping_curve(double opening, const struct parameters *p)
{
    double size = fabs(opening), share = p->hydraulic_damping_centre_share;
    double centre = p->hydraulic_damping_saturation_velocity
        - p->hydraulic_damping_saturation_narrowing * size;
    double shift = p->hydraulic_damping_saturation_shift * opening;
    struct curve c = {.extending = centre + shift, .retracting = centre - shift};
    c.width = p->hydraulic_damping_velocity_width * (1.0 + p->hydraulic_damping_width_growth * size);
    c.magnitude = 0.5 * p->hydraulic_damping_maximum_force * (share + (1.0 - share) * size);
    c.at_rest = fast_tanh(c.retracting / c.width) - fast_tanh(c.extending / c.width);
    return c;
}

static inline double damping_force(double velocity, struct curve c, const struct parameters *p,
                                   double *slope)
{
    double bound = p->hydraulic_damping_maximum_force;
    if (p->hydraulic_damping_model == LINEAR) {
        *slope = p->hydraulic_damping_linear_gain;
        return *slope * velocity;
    }
    *slope = 0.0;
    if (p->hydraulic_damping_model != FULL || bound == 0.0)
        return 0.0;
    double out = fast_tanh((velocity - c.extending) / c.width);
    double back = fast_tanh((velocity + c.retracting) / c.width);
    double force = c.magnitude * (out + back - c.at_rest) + p->hydraulic_damping_viscous * velocity;
    double bounded = fast_tanh(force / bound);
    *slope = (c.magnitude / c.width * (2.0 - out * out - back * back)
              + p->hydraulic_damping_viscous) * (1.0 - bounded * bounded);
    return bound * bounded;
}

static inline double sliding_friction(double velocity, const struct parameters *p)
{
    double relative = velocity / p->friction_stribeck_velocity;
    if (fabs(relative) > FAR)
        return p->friction_coulomb;
    double stiction = velocity >= 0.0 ? p->friction_stiction_push : p->friction_stiction_pull;
    return p->friction_coulomb + (stiction - p->friction_coulomb) * exp(-relative * relative);
}

static inline double sliding_share(double deflection, double velocity, double limit)
{
    double elastic = ELASTIC_SHARE * limit, size = fabs(deflection);
    if (deflection * velocity <= 0.0 || size <= elastic)
        return 0.0;
    if (size >= limit)
        return 1.0;
    return 0.5 + 0.5 * sin(M_PI * (size - 0.5 * (limit + elastic)) / (limit - elastic));
}

static inline void deflect(double before, double velocity, const struct parameters *p, double h,
                           struct rub *r)
{
    double limit = sliding_friction(velocity, p) / p->friction_presliding_stiffness;
    r->seal = r->seal_slope = 0.0;
    if (limit <= 0.0)
        return;
    double speed = fabs(velocity);
    double loss = sliding_share(before, velocity, limit) / limit;
    double middle = (before + 0.5 * h * velocity) / (1.0 + 0.5 * h * loss * speed);
    loss = sliding_share(middle, velocity, limit) / limit;
    double x = h * loss * speed, fall = 1.0 + x + 0.5 * x * x;
    double after = (before + h * velocity * (1.0 + 0.5 * x)) / fall;
    double bound = fmax(limit, fabs(before));
    if (fabs(after) > bound) {
        r->seal = copysign(bound, after);
    } else {
        r->seal = after;
        r->seal_slope = 0.5 * h * (1.0 + x) / fall * fmax(0.0, 1.0 - loss * fabs(after));
    }
}

static inline struct rub friction(double before, double mean_velocity, double velocity,
                                  const struct parameters *p, double h)
{
    struct rub r = {0};
    if (p->friction_model == LINEAR) {
        r.force_slope = p->friction_linear_gain;
        r.force = r.force_slope * velocity;
    }
    if (p->friction_model != FULL)
        return r;
    double stiffness = p->friction_presliding_stiffness, damping = p->friction_presliding_damping;
    deflect(before, mean_velocity, p, h, &r);
    double limit = sliding_friction(velocity, p) / stiffness, elastic = 0.0;
    if (limit > 0.0)
        elastic = fmax(0.0, 1.0 - sliding_share(r.seal, velocity, limit) * fabs(r.seal) / limit);
    r.force = stiffness * r.seal + damping * elastic * velocity;
    r.force_slope = stiffness * r.seal_slope + damping * elastic;
    return r;
}

static double prescribed_velocity(double time, const struct parameters *p)
{
    if (p->load_frequency == 0.0)
        return p->load_velocity;
    return p->load_velocity * sin(2.0 * M_PI * p->load_frequency * time);
}

static inline void load(struct state *s, double static_before, double static_after,
                        const struct parameters *p, const struct constants *k)
{
    double opening = clamp(s->valve_position / p->valve_characteristic_full_opening, -1.0, 1.0);
    struct curve curve = damping_curve(opening, p);
    double h = k->h, stiffness = 0.0, damper = 0.0, inertia = p->load_mass / h;
    if (p->load_type == LOCKED) {
        stiffness = p->load_locked_stiffness;
        damper = p->load_locked_damping;
    } else if (p->load_type == SPRING) {
        stiffness = p->load_stiffness;
        damper = p->load_damping;
    }
    double known = k->keep * s->hydraulic_force + k->new * static_after
        + k->old * (static_before - s->damping_force);
    double begin = p->load_external_force - stiffness * s->position
        + 0.5 * (s->hydraulic_force - s->friction_force);
    int moves = p->load_type != PRESCRIBED;
    double velocity = moves ? s->velocity + s->velocity_change
                            : prescribed_velocity(s->time + h, p);
    double low = -INFINITY, high = INFINITY, change = 0.0, damping = 0.0, slope = 0.0;
    double hydraulic = 0.0;
    struct rub rub = {0};
    for (int round = 0; round < MOST_ROUNDS; round++) {
        velocity += change;
        damping = damping_force(velocity, curve, p, &slope);
        hydraulic = known - k->new * damping;
        double mean = 0.5 * (s->velocity + velocity);
        rub = friction(s->seal, mean, velocity, p, h);
        if (!moves)
            break;
        double residual = inertia * (velocity - s->velocity) - begin
            - 0.5 * (hydraulic - rub.force) + (damper + 0.5 * h * stiffness) * mean;
        change = -residual / (inertia + 0.25 * h * stiffness
                              + 0.5 * (k->new * slope + rub.force_slope + damper));
        if (fabs(change) <= STRAIGHT)
            break;
        if (residual > 0.0)
            high = velocity;
        else
            low = velocity;
        if (!(low <= velocity + change && velocity + change <= high))
            change = 0.5 * (low + high) - velocity;
    }
    velocity += change;
    s->position += 0.5 * h * (s->velocity + velocity);
    s->velocity_change = velocity - s->velocity;
    s->velocity = velocity;
    s->hydraulic_force = hydraulic - k->new * slope * change;
    s->damping_force = damping + slope * change;
    s->seal = rub.seal + rub.seal_slope * change;
    s->friction_force = rub.force + rub.force_slope * change;
}

static inline double felt_force(const struct state *s, const struct parameters *p)
{
    double transmitted = s->hydraulic_force - s->friction_force, inertia;
    if (p->force_sensor_mass_share == 0.0)
        return transmitted;
    if (p->load_type == PRESCRIBED) {
        double w = 2.0 * M_PI * p->load_frequency;
        inertia = p->load_mass * p->load_velocity * w * cos(w * s->time);
    } else {
        inertia = transmitted + p->load_external_force;
        if (p->load_type == LOCKED)
            inertia -= p->load_locked_stiffness * s->position + p->load_locked_damping * s->velocity;
        else if (p->load_type == SPRING)
            inertia -= p->load_stiffness * s->position + p->load_damping * s->velocity;
    }
    return transmitted - p->force_sensor_mass_share * inertia;
}

static void jump(struct state *s, double command, const struct parameters *p,
                 const struct constants *k)
{
    double slope;
    magnetise(s, command, 1.0, p);
    if (p->valve_flexure_model != FULL)
        s->valve_position = valve_position(
            (p->valve_flexure_model == LINEAR ? p->valve_flexure_linear_gain : 1.0) * s->drive, p);
    if (p->load_type == PRESCRIBED)
        s->velocity = prescribed_velocity(s->time, p);
    s->friction_force = friction(s->seal, s->velocity, s->velocity, p, 0.0).force;
    double opening = clamp(s->valve_position / p->valve_characteristic_full_opening, -1.0, 1.0);
    s->damping_force = damping_force(s->velocity, damping_curve(opening, p), p, &slope);
    if (p->fluid_dynamics_model != FULL)
        s->hydraulic_force = k->new * (static_force(s->valve_position, p) - s->damping_force);
}

static inline void substep(struct state *s, double command, const struct parameters *p,
                           const struct constants *k)
{
    double before = s->drive;
    double middle = magnetise(s, command, k->half_decay, p);
    double after = magnetise(s, command, k->half_decay, p);
    s->ring_index = (s->ring_index + 1) & (RING - 1);

    double static_before = static_force(s->valve_position, p), deflection;
    if (p->valve_flexure_model == FULL) {
        double mean = (before + 4.0 * middle + after) / 6.0, coil_before = s->coil;
        s->coil = mean + (s->coil - mean) * k->coil_decay;
        lag(&s->flexure, &s->flexure_rate, 0.5 * (coil_before + s->coil), k->pipe);
        deflection = delayed(s->flexure_ring, s->ring_index, s->flexure, k->valve_delay);
    } else {
        deflection = (p->valve_flexure_model == LINEAR ? p->valve_flexure_linear_gain : 1.0) * after;
    }
    s->valve_position = valve_position(deflection, p);

    double felt_before = felt_force(s, p);
    load(s, static_before, static_force(s->valve_position, p), p, k);
    s->time += k->h;
    double felt = felt_force(s, p);
    if (p->force_sensor_model == FULL) {
        double sensor_before = s->sensor;
        lag(&s->sensor, &s->sensor_rate, 0.5 * (felt_before + felt), k->sensor);
        lag(&s->card, &s->card_rate, 0.5 * (sensor_before + s->sensor), k->card);
        s->sensed = delayed(s->sensor_ring, s->ring_index, s->card, k->sensor_delay);
    } else {
        s->sensed = felt
            * (p->force_sensor_model == LINEAR ? p->force_sensor_linear_gain : 1.0);
    }
}

/* The same as `simulate` of asi_actuator/model/actuator.py without noise; out: 4 rows of n. */
void simulate(const struct parameters *p, const double *commands, long n, double period,
              struct state *s, double *out)
{
    long count = (long)fmax(1.0, ceil(period / p->maximum_substep * (1.0 - 1e-12)));
    struct constants k = constants(p, period / count);
    for (long i = 0; i < n; i++) {
        out[i] = p->force_sensor_gain * s->sensed + p->force_sensor_offset;
        out[n + i] = s->valve_position;
        out[2 * n + i] = s->position;
        out[3 * n + i] = s->velocity;
        double command = clamp(commands[i], -p->command_limit, p->command_limit);
        jump(s, command, p, &k);
        for (long j = 0; j < count; j++)
            substep(s, command, p, &k);
    }
}
