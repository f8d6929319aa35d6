// The form of a re-identification: recordings with labels, and one POST to /v1/recipes/reidentify.

import { overrides, shown, submits } from './fields.js';
import { algorithmOf, channelsOf, chosenModel, drawChannels, number, numbers } from './recipes.js';

const form = document.getElementById('batch-form');
const field = (name) => form.elements.namedItem(name);
const labels = () => [...form.querySelectorAll('[data-dataset]')];
let model = null;
let drawnFor = null;

const chosen = () => labels().filter((one) => one.value.trim() !== '');
const recorded = () => (chosen()[0]?.dataset.channels ?? '').split('\n').filter(Boolean);

function channels() {
  const names = recorded();
  const now = JSON.stringify([model?.name, names]);
  if (!model || now === drawnFor) return;
  drawnFor = now;
  drawChannels(model, names);
}

function count() {
  const runs = chosen().length;
  const values = new Set(chosen().map((one) => number(one.value))).size;
  document.getElementById('runs-count').textContent =
    `${runs} run${runs === 1 ? '' : 's'} at ${values} value${values === 1 ? '' : 's'} of ${field('label').value.trim() || 'the label'}`;
}

function filter() {
  const text = field('filter').value.trim().toLowerCase();
  for (const row of form.querySelectorAll('tr[data-name]'))
    row.hidden = !row.dataset.name.toLowerCase().includes(text) && row.querySelector('input').value.trim() === '';
}

function body() {
  const batch = chosen().map((one, place) => {
    one.dataset.pointer = `/batch/${place}`;
    return { x: number(one.value), datasets: [one.dataset.dataset] };
  });
  const words = (text) => text.split(/[,;\s]+/).filter(Boolean);
  return {
    name: field('name').value.trim() || null,
    model: field('model').value,
    label: field('label').value.trim(),
    batch,
    reference: field('reference').value || null,
    warm_start: field('warm_start').value || null,
    trend_parameters: words(field('trend_parameters').value),
    predict: numbers(field('predict').value),
    channels: channelsOf(form),
    parameters: overrides(),
    algorithm: algorithmOf(form),
    seed: number(field('seed').value) ?? 1,
  };
}

async function modelChosen() {
  model = null;
  const found = await chosenModel(form);
  if (!found) return;
  model = found;
  channels();
}

field('model').addEventListener('change', shown(form, modelChosen));
field('filter').addEventListener('input', filter);
form.addEventListener('input', () => {
  channels();
  count();
});
submits(form, '/v1/recipes/reidentify', body);
count();
shown(form, modelChosen)();
