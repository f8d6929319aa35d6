// The form of a noise sweep: how many runs it makes, and one POST to /v1/recipes/noise-sweep.

import { address, makeElement } from './live.js';
import { parseNumber, readAlgorithm, readOverrides, withFaults, onSubmit } from './fields.js';
import { readChannels, loadChosenModel, drawChannels, listInputs, parseNumbers } from './recipes.js';

const form = document.getElementById('sweep-form');
const field = (name) => form.elements.namedItem(name);
let model = null;

const isTruth = () => field('source').value === 'truth';
const listMethods = () => [...form.querySelectorAll('[name="methods"]:checked')].map((box) => box.value);

/** Make a text field with a label, for one pointer of the body. */
function makeField(text, pointer, data, hint = '') {
  const label = makeElement('label', text);
  const input = document.createElement('input');
  Object.assign(input.dataset, { pointer, ...data });
  input.placeholder = hint;
  label.append(input);
  return label;
}

function drawTruth() {
  const formatUnit = (unit) => (unit && unit !== '1' ? ` [${unit}]` : '');
  const parameters = Object.entries(model.parameters ?? {})
    .filter(([, parameter]) => parameter?.tied === undefined)
    .map(([name, parameter]) => makeField(`true ${name}${formatUnit(parameter?.unit)}`, `/truth/parameters/${name}`,
      { truth: name, missing: `Give the true value of ${name}.` }));
  const inputs = listInputs(model).map((name) =>
    makeField(`input ${name}${formatUnit(model.inputs[name])}`, `/truth/inputs/${name}`,
      { input: name, missing: `Write the input ${name} as a function of the time t, such as 10*cos(5*t).` }, 'such as 10*cos(5*t)'));
  document.getElementById('truth-values').replaceChildren(...parameters, ...inputs);
}

function drawSource() {
  document.getElementById('truth').hidden = !isTruth();
  document.getElementById('recording').hidden = isTruth();
  showRunCount();
}

const listRecordedChannels = () => (field('dataset').selectedOptions[0]?.dataset.channels ?? '').split('\n').filter(Boolean);

async function loadModel() {
  model = null;
  document.getElementById('truth-values').replaceChildren();
  const chosen = await loadChosenModel(form);
  if (!chosen) return;
  model = chosen;
  drawTruth();
  drawChannels(model, listRecordedChannels());
}

/** Show how many runs the job will have. */
function showRunCount() {
  const status = document.getElementById('runs-count');
  const sigma = new Set(parseNumbers(field('sigma').value));
  const replicates = Number(field('replicates').value);
  const nMethods = listMethods().length;
  if (!sigma.size || !Number.isInteger(replicates) || replicates < 1 || !nMethods) {
    status.textContent = 'σ, replicates or methods are missing';
    return;
  }
  const runs = (n) => (n * replicates * nMethods).toLocaleString('en').replaceAll(',', '\u202f');
  const product = `${sigma.size} σ × ${replicates} replicates × ${nMethods} method${nMethods > 1 ? 's' : ''} = ${runs(sigma.size)} runs`;
  const hasReference = isTruth() || sigma.has(0) || field('dataset').selectedOptions[0]?.dataset.truth === '1';
  status.textContent = hasReference ? product : `${product}, and ${runs(1)} at σ = 0 as the reference of the errors`;
}

function readTruth() {
  const values = { parameters: {}, inputs: {}, samples: parseNumber(field('samples').value), sample_time: parseNumber(field('sample_time').value) };
  for (const input of form.querySelectorAll('input[data-truth]')) {
    const value = parseNumber(input.value);
    if (value !== null) values.parameters[input.dataset.truth] = value;
  }
  for (const input of form.querySelectorAll('[data-input]'))
    if (input.value.trim()) values.inputs[input.dataset.input] = { kind: 'expression', expression: input.value.trim() };
  return values;
}

function buildBody() {
  const source = isTruth()
    ? { truth: readTruth() }
    : { datasets: [field('dataset').value].filter(Boolean), channels: readChannels(form) };
  return {
    name: field('name').value.trim() || null,
    model: field('model').value,
    ...source,
    sigma: parseNumbers(field('sigma').value),
    relative: field('relative').checked,
    replicates: parseNumber(field('replicates').value),
    methods: listMethods(),
    seed: parseNumber(field('seed').value) ?? 1,
    parameters: readOverrides(),
    algorithm: readAlgorithm(form),
  };
}

field('model').addEventListener('change', withFaults(form, loadModel));
field('dataset').addEventListener('change', () => {
  if (model) drawChannels(model, listRecordedChannels());
  showRunCount();
});
for (const button of field('source')) button.addEventListener('change', drawSource);
form.addEventListener('input', showRunCount);
onSubmit(form, address('/v1/recipes/noise-sweep'), buildBody);
const wanted = new URLSearchParams(location.search).get('dataset');
if (wanted && [...field('dataset').options].some((option) => option.value === wanted)) {
  field('dataset').value = wanted;
  field('source').value = 'dataset';
}
drawSource();
withFaults(form, loadModel)();
