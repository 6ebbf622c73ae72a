% Write every variable of a NetCDF file as text: a line "name class units", then the numbers, the fastest dimension of the file first.
% A time is an int64 that printf would round, so it goes out as two numbers: whole thousand millions and the rest.
pkg load netcdf
arguments = argv();
[path, target] = arguments{end-1:end};
out = fopen(target, 'w');
for variable = ncinfo(path).Variables
  values = ncread(path, variable.Name);
  units = '';
  for attribute = variable.Attributes
    if strcmp(attribute.Name, 'units'), units = attribute.Value; end
  end
  fprintf(out, '%s|%s|%s\n', variable.Name, class(values), units);
  if ischar(values)
    fprintf(out, '%s\n', values(:)');
  elseif isa(values, 'int64')
    whole = idivide(values(:), int64(1000000000), 'fix');
    fprintf(out, '%d:%d ', [double(whole), double(values(:) - whole * 1000000000)]');
    fprintf(out, '\n');
  else
    fprintf(out, '%.17g ', double(values(:)));
    fprintf(out, '\n');
  end
end
fclose(out);
