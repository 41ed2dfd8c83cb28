// Times Pinocchio's recursive Newton–Euler: `rnea MODEL CALLS QUERIES TIMES`, with the files of timing.c.
// As a library, it computes batches.
#include <pinocchio/fwd.hpp>

#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/multibody.hpp>
#include <pinocchio/serialization.hpp>

#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <vector>

struct Robot
{
    pinocchio::Model model;
    pinocchio::Data data;
};

extern "C" Robot *read_robot(const char *path)
{
    pinocchio::Model model;
    model.loadFromText(path);
    return new Robot{model, pinocchio::Data(model)};
}

extern "C" void rnea_batch(Robot *robot, long count, const double *motions, double *tau)
{
    using Vector = Eigen::Map<const Eigen::VectorXd>;
    const long nq = robot->model.nq, nv = robot->model.nv;
    for (long k = 0; k < count; k++) {
        const double *at = motions + k * (nq + 2 * nv);
        const Vector q(at, nq), v(at + nq, nv), a(at + nq + nv, nv);
        Eigen::Map<Eigen::VectorXd>(tau + k * nv, nv) = pinocchio::rnea(robot->model, robot->data, q, v, a);
    }
}

int main(int count, char **given)
{
    using Clock = std::chrono::steady_clock;
    if (count != 5)
        return 1;
    pinocchio::Model model;
    model.loadFromText(given[1]);
    pinocchio::Data data(model);
    std::ifstream file(given[3], std::ios::binary);
    const std::vector<char> bytes{std::istreambuf_iterator<char>(file), {}};
    const double *numbers = reinterpret_cast<const double *>(bytes.data());
    const long size = model.nq + 2 * model.nv, queries = static_cast<long>(bytes.size() / sizeof(double)) / size;
    std::vector<Eigen::VectorXd> q, v, a;
    for (long k = 0; k < queries; k++) {
        const double *at = numbers + k * size;
        q.push_back(Eigen::Map<const Eigen::VectorXd>(at, model.nq));
        v.push_back(Eigen::Map<const Eigen::VectorXd>(at + model.nq, model.nv));
        a.push_back(Eigen::Map<const Eigen::VectorXd>(at + model.nq + model.nv, model.nv));
    }
    std::vector<std::int64_t> times(static_cast<std::size_t>(std::atol(given[2])));
    for (std::size_t k = 0; k < times.size(); k++) {
        const std::size_t at = k % q.size();
        const auto began = Clock::now();
        pinocchio::rnea(model, data, q[at], v[at], a[at]);
        times[k] = std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now() - began).count();
    }
    std::ofstream out(given[4], std::ios::binary);
    out.write(reinterpret_cast<const char *>(times.data()), static_cast<std::streamsize>(8 * times.size()));
    return out.good() ? 0 : 1;
}
