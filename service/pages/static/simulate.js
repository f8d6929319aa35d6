// The form of a simulation: what is typed for the controller is used, so the tuning is by hand then.

const form = document.querySelector('form.job');

form.addEventListener('input', ({ target }) => {
  if (['gain', 'integral_time', 'derivative_time'].includes(target.name)) form.elements.tuning.value = 'by hand';
});
