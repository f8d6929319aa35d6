// The form of a re-identification: recordings with labels, and one POST to /v1/recipes/reidentify.

import { address } from './live.js';
import { parseNumber, readAlgorithm, readOverrides, withFaults, onSubmit } from './fields.js';
import { readChannels, loadChosenModel, drawChannels, parseNumbers } from './recipes.js';

const form = document.getElementById('batch-form');
const field = (name) => form.elements.namedItem(name);
const listLabels = () => [...form.querySelectorAll('[data-dataset]')];
let model = null;
let drawnChoice = null;

const listChosen = () => listLabels().filter((input) => input.value.trim() !== '');
const listRecordedChannels = () => (listChosen()[0]?.dataset.channels ?? '').split('\n').filter(Boolean);

function updateChannels() {
  const names = listRecordedChannels();
  const now = JSON.stringify([model?.name, names]);
  if (!model || now === drawnChoice) return;
  drawnChoice = now;
  drawChannels(model, names);
}

function showRunCount() {
  const runs = listChosen().length;
  const values = new Set(listChosen().map((input) => parseNumber(input.value))).size;
  document.getElementById('runs-count').textContent =
    `${runs} run${runs === 1 ? '' : 's'} at ${values} value${values === 1 ? '' : 's'} of ${field('label').value.trim() || 'the label'}`;
}

function filterRows() {
  const text = field('filter').value.trim().toLowerCase();
  for (const row of form.querySelectorAll('tr[data-name]'))
    row.hidden = !row.dataset.name.toLowerCase().includes(text) && row.querySelector('input').value.trim() === '';
}

function buildBody() {
  const batch = listChosen().map((input, place) => {
    input.dataset.pointer = `/batch/${place}`;
    return { x: parseNumber(input.value), datasets: [input.dataset.dataset] };
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
    predict: parseNumbers(field('predict').value),
    channels: readChannels(form),
    parameters: readOverrides(),
    algorithm: readAlgorithm(form),
    seed: parseNumber(field('seed').value) ?? 1,
  };
}

async function loadModel() {
  model = null;
  const chosen = await loadChosenModel(form);
  if (!chosen) return;
  model = chosen;
  updateChannels();
}

field('model').addEventListener('change', withFaults(form, loadModel));
field('filter').addEventListener('input', filterRows);
form.addEventListener('input', () => {
  updateChannels();
  showRunCount();
});
onSubmit(form, address('/v1/recipes/reidentify'), buildBody);
showRunCount();
withFaults(form, loadModel)();
