/* Calls code that CasADi has generated for a batch; states and torques are row-major, (N, n). */
#include <stdlib.h>

typedef long long int whole;

int rnea(const double **arguments, double **results, whole *integers, double *numbers, int memory);
int rnea_work(whole *arguments, whole *results, whole *integers, whole *numbers);

int rnea_batch(whole count, whole joints, const double *q, const double *dq, const double *ddq, double *tau)
{
    whole sizes[4], k;
    const double **arguments;
    double **results, *numbers;
    whole *integers;
    int failed = rnea_work(sizes, sizes + 1, sizes + 2, sizes + 3);
    arguments = malloc((sizes[0] + 3) * sizeof *arguments);
    results = malloc((sizes[1] + 1) * sizeof *results);
    integers = malloc((sizes[2] + 1) * sizeof *integers);
    numbers = malloc((sizes[3] + 1) * sizeof *numbers);
    for (k = 0; k < count && !failed; k++) {
        arguments[0] = q + k * joints;
        arguments[1] = dq + k * joints;
        arguments[2] = ddq + k * joints;
        results[0] = tau + k * joints;
        failed = rnea(arguments, results, integers, numbers, 0);
    }
    free(arguments);
    free(results);
    free(integers);
    free(numbers);
    return failed;
}
