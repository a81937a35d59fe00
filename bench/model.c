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
enum { NEAREST, EDGE, ZERO };
enum { MASS, SPRING_ALONE, SPRING_AND_DAMPER };

#define ELASTIC_SHARE 0.7
#define FAR 7.0
#define ELEMENTS 4
#define BEFORE 0
#define AFTER 1
#define SLOPE 2
#define LEAST_STEEPNESS 0.25
#define NEAR 1e-6
#define LEAST_LIMIT 1e-100
#define LINEAR_STEP 5e-6
#define MOST_ROUNDS 60

struct second_order { double keep, pull, half_step; };
struct delay { long whole; double part; };
struct first_order { double keep, old, new; };
struct constants {
    double half_decay, coil_decay, supply_keep, delay_substeps;
    long delay_periods;
    struct first_order fluid, valve_lag, second_valve_lag, sensor_lag, second_sensor_lag;
    struct second_order pipe, sensor, card;
    struct delay valve_delay, sensor_delay;
    double h;
};
struct rub { double force, slope; };

static inline double clamp(double x, double low, double high)
{
    return fmin(fmax(x, low), high);
}

static inline double fast_tanh(double x)
{
    return 1.0 - 2.0 / (exp(2.0 * x) + 1.0);
}

static inline struct first_order first_order(double frequency, double h)
{
    double x = 2.0 * M_PI * frequency * h, lost = -expm1(-x), mean = lost / x;
    return (struct first_order){1.0 - lost, mean - (1.0 - lost), 1.0 - mean};
}

static struct first_order lag_of(double time, double h)
{
    return time == 0.0 ? (struct first_order){0.0, 0.0, 1.0} : first_order(0.5 / (M_PI * time), h);
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

static inline double fluid_gain(const struct parameters *p)
{
    return p->fluid_dynamics_model == LINEAR ? p->fluid_dynamics_linear_gain : 1.0;
}

static inline int leaks(const struct parameters *p)
{
    return p->fluid_dynamics_leakage > 0.0 || p->fluid_dynamics_leakage_growth > 0.0
        || p->fluid_dynamics_air_time > 0.0;
}

static inline struct first_order leaking(double force, const struct parameters *p, double h)
{
    double size = fabs(force);
    double leak = 1.0 + p->fluid_dynamics_leakage + p->fluid_dynamics_leakage_growth * size;
    double time = p->fluid_dynamics_air_time / (1.0 + size / p->fluid_dynamics_air_force);
    double gain = fluid_gain(p) / leak;
    if (p->fluid_dynamics_model == FULL)
        time += 0.5 / (M_PI * p->fluid_dynamics_frequency);
    if (time == 0.0)
        return (struct first_order){0.0, 0.0, gain};
    struct first_order lag = first_order(0.5 * leak / (M_PI * time), h);
    return (struct first_order){lag.keep, gain * lag.old, gain * lag.new};
}

static struct constants constants(const struct parameters *p, double period, double h)
{
    struct constants c = {.h = h};
    c.supply_keep = exp(-h / p->valve_characteristic_supply_time);
    c.delay_periods = (long)fmin(p->command_path_delay / period, RING - 2);
    c.delay_substeps = fmin((p->command_path_delay - c.delay_periods * period) / h, period / h);
    c.valve_lag = lag_of(p->valve_flexure_lag_time, h);
    c.second_valve_lag = lag_of(p->valve_flexure_second_lag_time, h);
    c.sensor_lag = lag_of(p->force_sensor_lag_time, h);
    c.second_sensor_lag = lag_of(p->force_sensor_second_lag_time, h);
    c.half_decay = exp(-M_PI * p->valve_hysteresis_rate_filter * h);
    c.coil_decay = exp(-2.0 * M_PI * p->valve_flexure_coil_frequency * h);
    c.pipe = second_order(p->valve_flexure_natural_frequency, p->valve_flexure_damping_ratio, h);
    c.sensor = second_order(p->force_sensor_natural_frequency, p->force_sensor_damping_ratio, h);
    c.card = second_order(p->force_sensor_card_frequency, sqrt(0.5), h);
    c.valve_delay = delay_steps(p->valve_flexure_delay, h);
    c.sensor_delay = delay_steps(p->force_sensor_delay, h);
    c.fluid = p->fluid_dynamics_model == FULL ? first_order(p->fluid_dynamics_frequency, h)
                                              : (struct first_order){0.0, 0.0, fluid_gain(p)};
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

static inline double uncovered(double position, const struct parameters *p)
{
    double off = position + p->valve_characteristic_bias, band = p->valve_characteristic_deadband;
    return band == 0.0 ? off : off - clamp(off, -band, band);
}

static inline double valve_opening(double position, const struct parameters *p)
{
    return clamp(uncovered(position, p) / p->valve_characteristic_full_opening, -1.0, 1.0);
}

static inline double static_force(double position, const struct parameters *p)
{
    double relative = uncovered(position, p) / p->valve_characteristic_full_opening;
    if (p->valve_characteristic_model == FULL)
        relative = clamp(relative, -1.0, 1.0);
    else if (p->valve_characteristic_model == LINEAR)
        relative *= p->valve_characteristic_linear_gain;
    double force = relative * p->valve_characteristic_maximum_force;
    double limit = p->valve_characteristic_flow_limit;
    if (limit > 0.0)
        force = clamp(force, -limit, limit);
    return force * (1.0 - p->valve_characteristic_supply_drop);
}

static inline double deflected(double deflection, const struct parameters *p)
{
    double off = deflection + p->valve_flexure_bias;
    if (p->valve_flexure_travel_limit == 0.0)
        return off;
    double stop = p->valve_flexure_travel_limit / p->valve_characteristic_full_opening
        * p->valve_characteristic_maximum_force / p->valve_characteristic_gain;
    return clamp(off, -stop, stop);
}

static inline double saturation(double x, double tail, double *slope)
{
    if (tail > 1.0) {
        double root = 1.0 / sqrt(1.0 + x * x), along = 0.5 * M_PI * x;
        *slope = (2.0 - tail) * root * root * root + (tail - 1.0) / (1.0 + along * along);
        return (2.0 - tail) * x * root + (tail - 1.0) * atan(along) * 2.0 / M_PI;
    }
    double bounded = fast_tanh(x);
    *slope = 1.0 - bounded * bounded;
    if (tail > 0.0) {
        double root = 1.0 / sqrt(1.0 + x * x);
        bounded += tail * (x * root - bounded);
        *slope += tail * (root * root * root - *slope);
    } else if (tail < 0.0) {
        bounded -= tail * (erf(0.5 * sqrt(M_PI) * x) - bounded);
        *slope -= tail * (exp(-0.25 * M_PI * x * x) - *slope);
    }
    return bounded;
}

struct curve { double magnitude, extending, retracting, width, at_rest, size; };

static inline struct curve damping_curve(double opening, const struct parameters *p)
{
    double size = fabs(opening), share = p->hydraulic_damping_centre_share;
    if (p->hydraulic_damping_model != FULL)
        return (struct curve){.size = size};
    double centre = p->hydraulic_damping_saturation_velocity
        - p->hydraulic_damping_saturation_narrowing * size;
    double shift = p->hydraulic_damping_saturation_shift * opening;
    struct curve c = {.extending = centre + shift, .retracting = centre - shift, .size = size};
    c.width = p->hydraulic_damping_velocity_width * (1.0 + p->hydraulic_damping_width_growth * size);
    c.magnitude = 0.5 * p->hydraulic_damping_maximum_force * (share + (1.0 - share) * size);
    double unused, tail = p->hydraulic_damping_tail;
    c.at_rest = saturation(c.retracting / c.width, tail, &unused)
        - saturation(c.extending / c.width, tail, &unused);
    return c;
}

static inline double tangents_force(double velocity, struct curve c, const struct parameters *p,
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
    double out_slope, back_slope, bounded_slope, tail = p->hydraulic_damping_tail;
    double out = saturation((velocity - c.extending) / c.width, tail, &out_slope);
    double back = saturation((velocity + c.retracting) / c.width, tail, &back_slope);
    double force = c.magnitude * (out + back - c.at_rest) + p->hydraulic_damping_viscous * velocity;
    double bounded = saturation(force / bound, tail, &bounded_slope);
    *slope = (c.magnitude / c.width * (out_slope + back_slope)
              + p->hydraulic_damping_viscous) * bounded_slope;
    return bound * bounded;
}

static inline double damping_force(double velocity, struct curve c, const struct parameters *p,
                                   double *slope)
{
    double force = tangents_force(velocity, c, p, slope);
    double quadratic = p->hydraulic_damping_quadratic;
    double viscous = p->hydraulic_damping_opening_viscous;
    if (quadratic > 0.0 || viscous > 0.0) {
        double grown = viscous * c.size + quadratic * fabs(velocity);
        force += grown * velocity;
        *slope += grown + quadratic * fabs(velocity);
    }
    return force;
}

static inline double coulomb_friction(int forward, const struct parameters *p)
{
    return p->friction_coulomb * (1.0 + (forward ? 1.0 : -1.0) * p->friction_coulomb_asymmetry);
}

static inline double stiction(int forward, const struct parameters *p)
{
    return forward ? p->friction_stiction_push : p->friction_stiction_pull;
}

static inline double stribeck(double velocity, const struct parameters *p)
{
    double relative = velocity / p->friction_stribeck_velocity;
    return fabs(relative) <= FAR ? exp(-relative * relative) : 0.0;
}

static inline double steady_friction(int forward, double left, const struct parameters *p)
{
    double coulomb = coulomb_friction(forward, p);
    return coulomb + (stiction(forward, p) - coulomb) * left;
}

static inline double common_friction(const struct parameters *p)
{
    return 0.5 * (fmax(stiction(1, p), coulomb_friction(1, p))
                  + fmax(stiction(0, p), coulomb_friction(0, p)));
}

static inline double breakaway_deflection(int forward, double left, const struct parameters *p)
{
    double force = steady_friction(forward, left, p), softening = p->friction_softening;
    if (softening != 0.0)
        force += softening * (common_friction(p) - force);
    return force / p->friction_presliding_stiffness;
}

static inline double softened(int forward, double velocity, double left,
                              const struct parameters *p, double *slope)
{
    double softening = p->friction_softening;
    *slope = 0.0;
    if (softening == 0.0)
        return 1.0;
    double slides = steady_friction(forward, left, p);
    double common = common_friction(p), whole = slides + softening * (common - slides);
    if (whole == 0.0)
        return 1.0;
    double falls = 2.0 * velocity / (p->friction_stribeck_velocity * p->friction_stribeck_velocity)
        * (slides - coulomb_friction(forward, p));
    *slope = -softening * (common / whole) * (falls / whole);
    return slides / whole;
}

static inline double quarter_wave(double x)
{
    double t = x * x, t2 = t * t;
    return x * ((1.5707963267948966 - 0.6459640975062232 * t)
                + t2 * (0.07969262624568336 - 0.004681754131447063 * t)
                + t2 * t2 * ((1.604411695631026e-4 - 3.5988107063136795e-6 * t)
                             + t2 * (5.688318064017795e-8 - 6.449471237809134e-10 * t)));
}

static inline double sliding(double along, const struct parameters *p)
{
    double slip = p->friction_presliding_slip, exponent = p->friction_presliding_exponent;
    double share = 1.0;
    if (slip != 1.0) {
        if (along <= ELASTIC_SHARE)
            share = 0.0;
        else if (along < 1.0)
            share = 0.5 + 0.5 * quarter_wave((along - 0.5 * (1.0 + ELASTIC_SHARE))
                                             * (2.0 / (1.0 - ELASTIC_SHARE)));
        share += slip * (1.0 - share);
    }
    if (exponent == 1.0)
        return share;
    double slides = fmax(share * along, -1.0);
    if (fabs(slides) < NEAR)
        return exponent * share;
    return slides >= 1.0 ? share : share * (1.0 - pow(1.0 - slides, exponent)) / slides;
}

static inline double deflect(double before, double velocity, double limit,
                             const struct parameters *p, double h, double *slope)
{
    *slope = 0.0;
    if (limit < LEAST_LIMIT)
        return 0.0;
    double speed = fabs(velocity), forward = copysign(1.0, velocity), inverse = 1.0 / limit;
    double loss = sliding(forward * before * inverse, p) * inverse;
    double middle = (before + 0.5 * h * velocity) / (1.0 + 0.5 * h * loss * speed);
    loss = sliding(forward * middle * inverse, p) * inverse;
    double x = h * loss * speed, whole = 1.0 / (1.0 + x + 0.5 * x * x);
    double after = (before + h * velocity * (1.0 + 0.5 * x)) * whole;
    double bound = fmax(limit, fabs(before));
    if (fabs(after) > bound)
        return copysign(bound, after);
    *slope = 0.5 * h * (1.0 + x) * whole * fmax(0.0, 1.0 - loss * forward * after);
    return after;
}

static inline int elements(const struct parameters *p, double *reach)
{
    double ratio = p->friction_element_ratio, shares = 0.0, inverse = 1.0 / ratio;
    *reach = 1.0;
    if (ratio == 1.0)
        return 1;
    for (int i = 0; i < ELEMENTS; i++)
        shares = shares * inverse + 1.0;
    *reach = shares / ELEMENTS;
    return ELEMENTS;
}

static inline struct rub friction(double (*seals)[ELEMENTS], double mean_velocity,
                                  double velocity, const struct parameters *p, double h)
{
    double viscous = p->friction_viscous;
    if (p->friction_model == LINEAR)
        viscous += p->friction_linear_gain;
    struct rub r = {viscous * velocity, viscous};
    if (p->friction_model != FULL)
        return r;
    double direction = copysign(1.0, velocity), left = stribeck(velocity, p);
    double held = breakaway_deflection(copysign(1.0, mean_velocity) > 0.0,
                                       stribeck(mean_velocity, p), p);
    double limit = breakaway_deflection(direction > 0.0, left, p);
    int damped = p->friction_presliding_damping > 0.0 && limit >= LEAST_LIMIT;
    double reach, ahead_slope, back_slope;
    double ahead = softened(1, velocity, left, p, &ahead_slope);
    double back = softened(0, velocity, left, p, &back_slope);
    int count = elements(p, &reach);
    for (int i = 0; i < count; i++) {
        double deflects;
        double after = deflect(seals[BEFORE][i], mean_velocity, reach * held, p, h, &deflects);
        seals[AFTER][i] = after;
        seals[SLOPE][i] = deflects;
        double share = after >= 0.0 ? ahead : back;
        double share_slope = after >= 0.0 ? ahead_slope : back_slope;
        double part = 1.0 / (count * reach), stiffness = p->friction_presliding_stiffness * part;
        r.force += share * stiffness * after;
        r.slope += stiffness * (share * deflects + share_slope * after);
        if (damped) {
            double along = direction * after / (reach * limit);
            double elastic = fmax(0.0, 1.0 - sliding(along, p) * fmax(along, -1.0));
            double damping = p->friction_presliding_damping * part * elastic;
            r.force += damping * velocity;
            r.slope += damping;
        }
        reach *= p->friction_element_ratio;
    }
    return r;
}

static inline void settle(double (*seals)[ELEMENTS], double change, const struct parameters *p)
{
    double reach;
    int count = elements(p, &reach);
    for (int i = 0; i < ELEMENTS; i++)
        seals[BEFORE][i] = i < count && p->friction_model == FULL
            ? seals[AFTER][i] + seals[SLOPE][i] * change : 0.0;
}

static double prescribed_velocity(double time, const struct parameters *p)
{
    if (p->load_frequency == 0.0)
        return p->load_velocity;
    return p->load_velocity * sin(2.0 * M_PI * p->load_frequency * time);
}

static inline double external_force(double time, const struct parameters *p)
{
    if ((p->load_external_force_end != 0.0 && time >= p->load_external_force_end - 1e-9)
        || time < p->load_external_force_start - 1e-9)
        return 0.0;
    if (p->load_external_force_frequency == 0.0)
        return p->load_external_force;
    return p->load_external_force
        * sin(2.0 * M_PI * (p->load_external_force_frequency * time
                            + p->load_external_force_phase));
}

struct hold { double stiffness, damper, origin; };
struct touch { double force, damping, push, inertia; };

static inline struct hold load_spring(const struct parameters *p)
{
    if (p->load_type == LOCKED)
        return (struct hold){p->load_locked_stiffness, p->load_locked_damping, 0.0};
    if (p->load_type == SPRING)
        return (struct hold){p->load_stiffness, p->load_damping, 0.0};
    return (struct hold){0.0, 0.0, 0.0};
}

static inline struct hold behind_gap(double position, struct hold spring,
                                     const struct parameters *p)
{
    if (p->backlash_gap == 0.0 || p->backlash_location == MASS)
        return spring;
    double half = 0.5 * p->backlash_gap, off = position - p->backlash_centre;
    double reach = clamp(off, -half, half);
    if (off == reach)
        return (struct hold){0.0, p->backlash_location == SPRING_AND_DAMPER ? 0.0 : spring.damper,
                             0.0};
    spring.origin = p->backlash_centre + reach;
    return spring;
}

static inline int two_masses(const struct parameters *p)
{
    return p->coupling_stiffness > 0.0 || (p->backlash_gap > 0.0 && p->backlash_location == MASS);
}

static inline double half_gap(const struct parameters *p)
{
    return p->backlash_location == MASS ? 0.5 * p->backlash_gap : 0.0;
}

static inline double contact_stiffness(const struct parameters *p)
{
    return p->coupling_stiffness > 0.0 ? p->coupling_stiffness : p->backlash_contact_stiffness;
}

static inline struct touch contact(const struct state *s, double velocity, double pushed,
                                   struct hold far, const struct parameters *p, double h)
{
    double half = 0.5 * h, inertia = 2.0 * (1.0 - p->coupling_piston_share) * p->load_mass / h;
    double push = inertia * s->load_velocity + pushed - far.stiffness * s->load_position;
    inertia += far.damper + half * far.stiffness;
    double gap = half_gap(p), ahead = s->position - p->backlash_centre - s->load_position;
    double apart = ahead + half * (velocity - push / inertia);
    if (gap > 0.0 && fabs(apart) <= gap)
        return (struct touch){0.0, 0.0, push, inertia};
    double reach = clamp(apart, -gap, gap), firm = contact_stiffness(p);
    double link = p->coupling_damping + half * firm, share = inertia / (inertia + link);
    double force = share * firm * (ahead - reach) - (1.0 - share) * push;
    if (gap > 0.0 && (force + share * link * velocity) * reach < 0.0)
        return (struct touch){0.0, 0.0, push, inertia};
    return (struct touch){force, share * link, push, inertia};
}

static inline double contact_force(const struct state *s, const struct parameters *p)
{
    double gap = half_gap(p), apart = s->position - p->backlash_centre - s->load_position;
    double reach = clamp(apart, -gap, gap);
    if (gap > 0.0 && apart == reach)
        return 0.0;
    double force = contact_stiffness(p) * (apart - reach)
        + p->coupling_damping * (s->velocity - s->load_velocity);
    return gap > 0.0 && force * reach < 0.0 ? 0.0 : force;
}

static inline void load(struct state *s, double static_before, double opening,
                        const struct parameters *p, const struct constants *k)
{
    struct curve curve = damping_curve(opening, p);
    double h = k->h, mass = p->load_mass;
    struct first_order fluid = leaks(p) ? leaking(s->hydraulic_force, p, h) : k->fluid;
    int moves = p->load_type != PRESCRIBED, apart = moves && two_masses(p);
    double pushed = external_force(
        p->load_external_force_frequency > 0.0 ? s->time + 0.5 * h : s->time, p);
    double velocity = moves ? s->velocity + s->velocity_change
                            : prescribed_velocity(s->time + h, p);
    struct hold held = load_spring(p);
    struct touch touch = {0};
    if (apart) {
        touch = contact(s, velocity, pushed, held, p, h);
        mass *= p->coupling_piston_share;
        held = (struct hold){0.0, touch.damping, 0.0};
        pushed = -touch.force;
    } else if (moves) {
        held = behind_gap(s->position, held, p);
    }
    double stiffness = held.stiffness, damper = held.damper, inertia = mass / h;
    double known = fluid.keep * s->hydraulic_force + fluid.new * s->static_force
        + fluid.old * (static_before - s->damping_force);
    double begin = pushed - stiffness * (s->position - held.origin)
        + 0.5 * (s->hydraulic_force - s->friction_force);
    double low = -INFINITY, high = INFINITY, change = 0.0, damping = 0.0, slope = 0.0;
    int linear = p->friction_model != FULL && p->hydraulic_damping_model != FULL
        && p->hydraulic_damping_quadratic == 0.0;
    double hydraulic = 0.0;
    struct rub rub = {0};
    for (int round = 0; round < MOST_ROUNDS; round++) {
        velocity += change;
        damping = damping_force(velocity, curve, p, &slope);
        hydraulic = known - fluid.new * damping;
        double mean = 0.5 * (s->velocity + velocity);
        rub = friction(s->seals, mean, velocity, p, h);
        if (!moves)
            break;
        double residual = inertia * (velocity - s->velocity) - begin
            - 0.5 * (hydraulic - rub.force) + (damper + 0.5 * h * stiffness) * mean;
        double steepness = inertia + 0.25 * h * stiffness
            + 0.5 * (fluid.new * slope + rub.slope + damper);
        change = -residual / fmax(steepness, LEAST_STEEPNESS * inertia);
        if (linear || fabs(change) <= LINEAR_STEP)
            break;
        if (residual > 0.0)
            high = velocity;
        else
            low = velocity;
        if (!(low <= velocity + change && velocity + change <= high))
            change = 0.5 * (low + high) - velocity;
    }
    velocity += change;
    if (apart) {
        double force = touch.force + 0.5 * touch.damping * (s->velocity + velocity);
        double mean = (touch.push + force) / touch.inertia;
        s->load_position += h * mean;
        s->load_velocity = 2.0 * mean - s->load_velocity;
    }
    s->position += 0.5 * h * (s->velocity + velocity);
    s->velocity_change = velocity - s->velocity;
    s->velocity = velocity;
    s->hydraulic_force = hydraulic - fluid.new * slope * change;
    s->damping_force = damping + slope * change;
    settle(s->seals, change, p);
    s->friction_force = rub.force + rub.slope * change;
}

static inline double felt_force(const struct state *s, const struct parameters *p)
{
    double net = s->hydraulic_force - s->friction_force, inertia;
    double transmitted = p->friction_location == 1.0 ? s->hydraulic_force : net;
    if (p->force_sensor_mass_share == 0.0)
        return transmitted;
    if (p->load_type == PRESCRIBED) {
        double w = 2.0 * M_PI * p->load_frequency;
        inertia = p->load_mass * p->load_velocity * w * cos(w * s->time);
    } else if (two_masses(p)) {
        inertia = net - contact_force(s, p);
    } else {
        struct hold held = behind_gap(s->position, load_spring(p), p);
        inertia = net + external_force(s->time, p) - held.stiffness * (s->position - held.origin)
            - held.damper * s->velocity;
    }
    return transmitted - p->force_sensor_mass_share * inertia;
}

static void jump(struct state *s, double command, const struct parameters *p,
                 const struct constants *k)
{
    double slope;
    magnetise(s, command, 1.0, p);
    if (p->valve_flexure_model != FULL && p->valve_flexure_deadband == 0.0
        && p->valve_flexure_lag_time == 0.0 && p->valve_flexure_second_lag_time == 0.0)
        s->valve_position = valve_position(deflected(
            (p->valve_flexure_model == LINEAR ? p->valve_flexure_linear_gain : 1.0) * s->drive, p),
            p);
    s->static_force = static_force(s->valve_position, p)
        * fmax(1.0 - p->valve_characteristic_supply_sag * s->supply_load, 0.0);
    if (p->load_type == PRESCRIBED)
        s->velocity = prescribed_velocity(s->time, p);
    s->friction_force = friction(s->seals, s->velocity, s->velocity, p, 0.0).force;
    double opening = valve_opening(s->valve_position, p);
    s->damping_force = damping_force(s->velocity, damping_curve(opening, p), p, &slope);
    if (p->fluid_dynamics_model != FULL && p->fluid_dynamics_air_time == 0.0) {
        double gain = leaks(p) ? leaking(s->hydraulic_force, p, 0.0).new : fluid_gain(p);
        s->hydraulic_force = gain * (s->static_force - s->damping_force);
    }
    s->felt_force = felt_force(s, p);
}

static inline void substep(struct state *s, double command, const struct parameters *p,
                           const struct constants *k)
{
    double before = s->drive;
    double middle = magnetise(s, command, k->half_decay, p);
    double after = magnetise(s, command, k->half_decay, p);
    s->ring_index = (s->ring_index + 1) & (RING - 1);

    double static_before = s->static_force, deflection;
    double mean = (before + 4.0 * middle + after) / 6.0, band = p->valve_flexure_deadband;
    if (band > 0.0) {
        mean -= clamp(mean, -band, band);
        after -= clamp(after, -band, band);
    }
    if (p->valve_flexure_lag_time > 0.0) {
        double earlier = s->lagged_drive;
        after = k->valve_lag.keep * earlier + (1.0 - k->valve_lag.keep) * mean;
        mean = 0.5 * (earlier + after);
    }
    s->lagged_drive = after;
    if (p->valve_flexure_second_lag_time > 0.0) {
        double earlier = s->twice_lagged_drive;
        after = k->second_valve_lag.keep * earlier + (1.0 - k->second_valve_lag.keep) * mean;
        mean = 0.5 * (earlier + after);
    }
    s->twice_lagged_drive = after;
    if (p->valve_flexure_model == FULL) {
        double coil_before = s->coil;
        s->coil = mean + (s->coil - mean) * k->coil_decay;
        lag(&s->flexure, &s->flexure_rate, 0.5 * (coil_before + s->coil), k->pipe);
        deflection = delayed(s->flexure_ring, s->ring_index, s->flexure, k->valve_delay);
    } else {
        deflection = (p->valve_flexure_model == LINEAR ? p->valve_flexure_linear_gain : 1.0) * after;
    }
    s->valve_position = valve_position(deflected(deflection, p), p);
    s->static_force = static_force(s->valve_position, p);
    double opening = valve_opening(s->valve_position, p);
    if (p->valve_characteristic_supply_sag > 0.0) {
        s->supply_load = fabs(opening) + k->supply_keep * (s->supply_load - fabs(opening));
        s->static_force *= fmax(1.0 - p->valve_characteristic_supply_sag * s->supply_load, 0.0);
    }

    load(s, static_before, opening, p, k);
    s->time += k->h;
    double felt_before = s->felt_force, felt = s->felt_force = felt_force(s, p);
    if (p->force_sensor_model == FULL) {
        double sensor_before = s->sensor;
        lag(&s->sensor, &s->sensor_rate, 0.5 * (felt_before + felt), k->sensor);
        lag(&s->card, &s->card_rate, 0.5 * (sensor_before + s->sensor), k->card);
        felt = delayed(s->sensor_ring, s->ring_index, s->card, k->sensor_delay);
    } else {
        felt *= p->force_sensor_model == LINEAR ? p->force_sensor_linear_gain : 1.0;
    }
    if (p->force_sensor_lag_time == 0.0 && p->force_sensor_second_lag_time == 0.0) {
        s->sensed = s->sensor_input = s->sensor_lagged = felt;
    } else {
        double first = k->sensor_lag.keep * s->sensor_lagged + k->sensor_lag.old * s->sensor_input
            + k->sensor_lag.new * felt;
        s->sensed = k->second_sensor_lag.keep * s->sensed
            + k->second_sensor_lag.old * s->sensor_lagged + k->second_sensor_lag.new * first;
        s->sensor_input = felt;
        s->sensor_lagged = first;
    }
}

static inline double quantised(double command, const struct parameters *p)
{
    double quantum = p->command_path_quantum, middle = p->command_path_rounding == EDGE ? 0.5 : 0.0;
    if (p->command_path_rounding == ZERO)
        return quantum * trunc(command / quantum);
    return quantum * (floor(command / quantum + 0.5 - middle) + middle);
}

static inline double arrived(const struct state *s, long number, const struct constants *k)
{
    double newer = s->command_ring[(s->sample - k->delay_periods) & (RING - 1)];
    double older = s->command_ring[(s->sample - k->delay_periods - 1) & (RING - 1)];
    return newer + clamp(k->delay_substeps - number, 0.0, 1.0) * (older - newer);
}

/* `simulate` of asi_actuator/model/actuator.py without noise, lost readings and uneven delays; out: 4 rows of n. */
void simulate(const struct parameters *p, const double *commands, long n, double period,
              struct state *s, double *out)
{
    long count = (long)fmax(1.0, ceil(period / p->maximum_substep * (1.0 - 1e-12)));
    struct constants k = constants(p, period, period / count);
    for (long i = 0; i < n; i++) {
        double wander = s->time * (p->force_sensor_drift + s->time * p->force_sensor_drift_curve);
        out[i] = p->force_sensor_gain * s->sensed + (p->force_sensor_offset + wander);
        out[n + i] = s->valve_position;
        out[2 * n + i] = s->position;
        out[3 * n + i] = s->velocity;
        double command = clamp(commands[i], -p->command_limit, p->command_limit);
        if (p->command_path_quantum > 0.0)
            command = quantised(command, p);
        s->command_ring[s->sample & (RING - 1)] = command;
        jump(s, p->command_path_delay > 0.0 ? arrived(s, 0, &k) : command, p, &k);
        for (long j = 0; j < count; j++)
            substep(s, p->command_path_delay > 0.0 ? arrived(s, j, &k) : command, p, &k);
        s->sample++;
    }
}
