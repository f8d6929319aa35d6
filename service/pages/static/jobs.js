// The list of jobs: refreshed every few seconds while a job is open and the page is visible.

import './lists.js';
import { Problem, address, post, refresh } from './live.js';

const EXAMPLE = {
  name: 'heated plate, an example',
  model: 'fopdt',
  parameters: { K: 0.8, T: 40, L: 12, y0: 20 },
  inputs: { u: { kind: 'expression', expression: '30 + 20*sin(0.021*t) + 15*sin(0.077*t)' } },
  samples: 600,
  sample_time: 1,
  noise: { sigma: 0.2, seed: 1 },
};
const EVERY_MS = 2000;
const list = document.querySelector('[data-live="jobs"]');

async function poll() {
  if (!document.hidden && list.dataset.open === '1') await refresh().catch(() => null);
  setTimeout(poll, EVERY_MS);
}

/** Store the example, and open the form with it. */
async function tryExample(button) {
  button.disabled = true;
  try {
    const { id } = await post(address('/v1/datasets:simulate'), EXAMPLE);
    location.assign(address(`/?dataset=${encodeURIComponent(id)}&fit=${EXAMPLE.model}#new`));
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    document.querySelector('[data-example-fault]').textContent = error.message;
    button.disabled = false;
  }
}

document.addEventListener('click', ({ target }) => {
  const button = target.closest('[data-example]');
  if (button) tryExample(button);
});
setTimeout(poll, EVERY_MS);
