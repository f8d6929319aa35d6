// The form of a noise sweep: how many runs it makes, and one POST to /v1/recipes/noise-sweep.

import { element } from './live.js';
import { overrides, shown, submits } from './fields.js';
import { algorithmOf, channelsOf, chosenModel, drawChannels, inputsOf, number, numbers } from './recipes.js';

const form = document.getElementById('sweep-form');
const field = (name) => form.elements.namedItem(name);
let model = null;

const isTruth = () => field('source').value === 'truth';
const methods = () => [...form.querySelectorAll('[name="methods"]:checked')].map((one) => one.value);

/** A text field with a label, for one place of the body. */
function typed(text, pointer, data, hint = '') {
  const label = element('label', text);
  const input = document.createElement('input');
  Object.assign(input.dataset, { pointer, ...data });
  input.placeholder = hint;
  label.append(input);
  return label;
}

function drawTruth() {
  const bracketed = (unit) => (unit && unit !== '1' ? ` [${unit}]` : '');
  const parameters = Object.entries(model.parameters ?? {})
    .filter(([, one]) => one?.tied === undefined)
    .map(([name, one]) => typed(`true ${name}${bracketed(one?.unit)}`, `/truth/parameters/${name}`, { truth: name }));
  const inputs = inputsOf(model).map((name) =>
    typed(`input ${name}${bracketed(model.inputs[name])}`, `/truth/inputs/${name}`, { input: name }, 'such as 10*cos(5*t)'));
  document.getElementById('truth-values').replaceChildren(...parameters, ...inputs);
}

function drawSource() {
  document.getElementById('truth').hidden = !isTruth();
  document.getElementById('recording').hidden = isTruth();
  count();
}

const recorded = () => (field('dataset').selectedOptions[0]?.dataset.channels ?? '').split('\n').filter(Boolean);

async function modelChosen() {
  model = null;
  document.getElementById('truth-values').replaceChildren();
  const found = await chosenModel(form);
  if (!found) return;
  model = found;
  drawTruth();
  drawChannels(model, recorded());
}

/** How many runs the job will have, before it is sent. */
function count() {
  const told = document.getElementById('runs-count');
  const sigma = new Set(numbers(field('sigma').value));
  const replicates = Number(field('replicates').value);
  const chosen = methods().length;
  if (!sigma.size || !Number.isInteger(replicates) || replicates < 1 || !chosen) {
    told.textContent = 'σ, replicates or methods are missing';
    return;
  }
  const runs = (n) => (n * replicates * chosen).toLocaleString('en').replaceAll(',', '\u202f');
  const product = `${sigma.size} σ × ${replicates} replicates × ${chosen} method${chosen > 1 ? 's' : ''} = ${runs(sigma.size)} runs`;
  const isKnown = isTruth() || sigma.has(0) || field('dataset').selectedOptions[0]?.dataset.truth === '1';
  told.textContent = isKnown ? product : `${product}, and ${runs(1)} at σ = 0 as the reference of the errors`;
}

function truth() {
  const found = { parameters: {}, inputs: {}, samples: number(field('samples').value), sample_time: number(field('sample_time').value) };
  for (const one of form.querySelectorAll('input[data-truth]')) {
    const value = number(one.value);
    if (value !== null) found.parameters[one.dataset.truth] = value;
  }
  for (const one of form.querySelectorAll('[data-input]'))
    if (one.value.trim()) found.inputs[one.dataset.input] = { kind: 'expression', expression: one.value.trim() };
  return found;
}

function body() {
  const source = isTruth()
    ? { truth: truth() }
    : { datasets: [field('dataset').value].filter(Boolean), channels: channelsOf(form) };
  return {
    name: field('name').value.trim() || null,
    model: field('model').value,
    ...source,
    sigma: numbers(field('sigma').value),
    relative: field('relative').checked,
    replicates: number(field('replicates').value),
    methods: methods(),
    seed: number(field('seed').value) ?? 1,
    parameters: overrides(),
    algorithm: algorithmOf(form),
  };
}

field('model').addEventListener('change', shown(form, modelChosen));
field('dataset').addEventListener('change', () => {
  if (model) drawChannels(model, recorded());
  count();
});
for (const one of field('source')) one.addEventListener('change', drawSource);
form.addEventListener('input', count);
submits(form, '/v1/recipes/noise-sweep', body);
const wanted = new URLSearchParams(location.search).get('dataset');
if (wanted && [...field('dataset').options].some((one) => one.value === wanted)) {
  field('dataset').value = wanted;
  field('source').value = 'dataset';
}
drawSource();
shown(form, modelChosen)();
